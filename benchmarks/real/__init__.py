"""Registration against real depth cameras: maps and objects of one sequence, with the truth known."""
