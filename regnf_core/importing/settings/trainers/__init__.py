"""One module a trainer: which of its settings' keys the gate knows, and what they mean."""
