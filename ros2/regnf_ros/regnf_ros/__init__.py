"""Asks a regnf service where detected objects stand, and publishes their poses."""
