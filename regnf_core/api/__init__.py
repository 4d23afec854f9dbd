"""What users call: the engine's functions, with fields by their paths and options as dictionaries."""
