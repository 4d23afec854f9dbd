"""Networks of plain layers as trainers write them, trained for a moment, and evaluated slowly and apart."""
