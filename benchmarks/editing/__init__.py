"""Edited scenes: pictures of them, and how near they come to the truth (docs/editing.md)."""
