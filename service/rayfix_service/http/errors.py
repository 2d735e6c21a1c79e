"""The error of a service that cannot start."""

from rayfix_tables.errors import RayfixError


class ServiceError(RayfixError):
    """The service cannot start with these options."""
