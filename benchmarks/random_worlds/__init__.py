"""Random worlds: a room, a table top or a shelf with things in it, how it was seen, and where everything is."""

from __future__ import annotations
