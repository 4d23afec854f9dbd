"""Color networks of the families' checkpoints, made ready for a regnf field file. One module a trainer."""
