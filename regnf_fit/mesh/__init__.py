"""Fitting a neural field to an exact one."""
