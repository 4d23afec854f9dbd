"""Which revision of the renderer this is: raised by hand whenever the same request gives other files."""

from __future__ import annotations

RENDERER_REVISION = 3
