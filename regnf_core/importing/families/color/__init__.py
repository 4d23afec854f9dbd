"""Color networks of the families' checkpoints, made ready for a safe field. One module a trainer."""
