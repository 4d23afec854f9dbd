"""Whole training runs with random settings, written and evaluated apart from regnf's own code."""
