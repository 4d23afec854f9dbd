"""Pictures of fields: depth, normals, colors and opacity along the rays of pinhole cameras (docs/editing.md)."""
