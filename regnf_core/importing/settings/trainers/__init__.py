"""Which of the trainers' settings the importer knows, and what their keys mean, by the kind of network."""
