"""Building images and running their containers where there is no container engine, for docker/test_images.py."""
