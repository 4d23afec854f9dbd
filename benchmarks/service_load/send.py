"""Uploads a file at a given moment of the monotonic clock, in a process of its own; prints when it began and ended.

python -m benchmarks.service_load.send ADDRESS FILE MOMENT
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from regnf_client import Client


def main() -> None:
    address, path, moment = sys.argv[1:]
    time.sleep(max(0.0, float(moment) - time.monotonic()))
    begun = time.monotonic()
    with Client(address) as service:
        service.upload(Path(path), wait=False)
    sys.stdout.write(f"{begun} {time.monotonic()}\n")


if __name__ == "__main__":
    main()
