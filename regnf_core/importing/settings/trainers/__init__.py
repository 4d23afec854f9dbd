"""Which of the trainers' settings the gate knows, and what their keys mean, by the kind of network."""
