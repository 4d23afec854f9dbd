"""What `regnf doctor` looks at, one file a subject."""
