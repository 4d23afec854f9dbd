"""Pose candidates from samples alone; no field is evaluated."""
