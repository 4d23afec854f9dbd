"""What every test shares."""

from __future__ import annotations

import os

# Threads of several processes that spin while they wait slow a shared machine tenfold. Set before torch loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")
