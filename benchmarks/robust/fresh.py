"""Measurements in a process of their own, with a number of threads that cannot be changed once torch has loaded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any


def in_fresh_process(module: str, threads: int, *arguments: str) -> Any:
    """What ``python -m module arguments`` prints as its last line, a JSON value."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE"}
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])
