"""Posed images of a scene: what they are, how they are read, written and rendered."""
