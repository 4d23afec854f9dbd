"""Which layouts of hash grids the gate reads right, without and with the trainer's settings: ``__main__``."""
