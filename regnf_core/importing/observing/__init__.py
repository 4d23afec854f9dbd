"""What was observed of an uploaded field: by the weights of a fused map, or by where its cameras stood."""
