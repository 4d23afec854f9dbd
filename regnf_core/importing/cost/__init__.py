"""How much work the evaluation of a field takes, told from its description and the shapes of its tensors alone."""
