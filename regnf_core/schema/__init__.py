"""What a stored field is, as plain data: kinds, descriptions and checks of their tensors. Builds nothing."""
