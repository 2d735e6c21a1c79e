"""Planning maps: accuracy over the floor of a site, predicted from its table alone."""
