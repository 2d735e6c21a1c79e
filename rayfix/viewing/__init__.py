"""Pages that show a site and its fixes without a service."""
