"""A whole training run, as a folder or an archive: which file is its checkpoint, and which are its settings."""
