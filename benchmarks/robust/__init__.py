"""The tables of the preset `robust`, one a module; see benchmarks/README.md."""
