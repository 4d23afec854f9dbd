"""Readers of file containers: zip, npz, safetensors, SQLite; and what tells them apart."""
