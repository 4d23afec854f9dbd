"""Fitting of neural signed distance fields: to meshes, and to posed images."""
