"""Many pairs at once, for a GPU: their poses in one batch, in parts of one size."""
