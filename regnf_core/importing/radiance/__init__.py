"""Radiance fields: their density, evaluated by numpy alone, and the depths that cameras see of it."""
