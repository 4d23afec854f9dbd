"""A whole scene populated with a library's objects: proposals, placements, and which of them stand together."""
