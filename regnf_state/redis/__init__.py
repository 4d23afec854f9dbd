"""Records, queue and counters in Redis."""
