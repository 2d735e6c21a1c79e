"""Scene files in, triangles with materials out; and the engine that finds what a ray hits."""
