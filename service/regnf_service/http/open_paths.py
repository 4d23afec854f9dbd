"""Addresses that need no token: the liveness probe, and the pages, which ask for the token themselves."""

from __future__ import annotations

import re

OPEN_PATHS = re.compile(r"(/v1)?/(healthz|docs)|/static/.*|(/v1)?/jobs/[A-Za-z0-9_-]+/view")
