"""The methods that regnf is measured against, all behind one interface; see benchmarks/README.md."""
