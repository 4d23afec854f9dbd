"""Signed distance fields: the protocol, the neural families, exact meshes, and the safe file format."""
