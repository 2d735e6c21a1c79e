"""Planning maps: how well a site will locate over its floor, told by its table alone."""
