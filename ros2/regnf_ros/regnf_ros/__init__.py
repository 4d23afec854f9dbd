"""Registers detected objects with a regnf service and publishes their poses."""
