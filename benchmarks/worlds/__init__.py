"""Random worlds, their fields and how they are registered: see ``python -m benchmarks.worlds --help``."""
