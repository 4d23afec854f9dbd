"""Edited scenes: objects are substituted, replaced, removed or inserted (docs/editing.md)."""
