"""The offline half: a site and its mesh become rays, mixtures and a table."""
