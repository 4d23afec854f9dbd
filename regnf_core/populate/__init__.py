"""A whole scene populated with a library's objects: proposals, placements, and what can stand together."""
