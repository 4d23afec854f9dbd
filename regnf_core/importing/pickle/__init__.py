"""A reader of pickles that imports nothing."""
