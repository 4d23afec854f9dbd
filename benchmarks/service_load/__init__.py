"""What the service shows under load: its overhead, several workers, many pollers, a soak."""
