"""Radiance fields of known shapes, written in the layouts of their trainers, and read back."""
