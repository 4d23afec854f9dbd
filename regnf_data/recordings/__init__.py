"""Recordings: depth images with cameras and poses, as sensors, data sets and trainers leave them, in one type."""
