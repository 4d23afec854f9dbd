"""Similarity transforms, boxes, points, metrics."""
