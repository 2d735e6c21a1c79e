"""The digital twin: the mesh cleaned, its planes, solids, curved surfaces and free space, and what a check finds."""
