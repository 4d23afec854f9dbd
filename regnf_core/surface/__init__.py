"""The zero level of a field: rays, cells, isosurface, point clouds."""
