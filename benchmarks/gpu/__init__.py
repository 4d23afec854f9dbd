"""The engine on a GPU: whether it gives what the CPU gives, and how long it takes."""
