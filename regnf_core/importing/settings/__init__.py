"""A trainer's settings files: read without making an object, and turned into what a description says."""
