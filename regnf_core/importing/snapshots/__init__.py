"""Snapshots of instant-ngp: one file with the radiance field, and all that its training knew of it."""
