"""The forward solver beside another one, and angle errors of antenna arrays."""
