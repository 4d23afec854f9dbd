"""Readers of file containers: zip, npz, safetensors, SQLite; and how they are recognized."""
