"""Registrations of single frames of folders in BOP's layout, judged by BOP's definitions."""
