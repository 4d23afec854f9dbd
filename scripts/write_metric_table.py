"""Write the table of the metrics that the job's page explains into docs/reference/metrics.md. A test compares the two.

python scripts/write_metric_table.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
SOURCE = _ROOT / "service" / "regnf_service" / "web" / "metrics.json"
TARGET = _ROOT / "docs" / "reference" / "metrics.md"
_PLACE = re.compile(r"(<!-- made by scripts/write_metric_table.py [^\n]*-->\n\n).*?(<!-- end -->)", flags=re.S)


def with_table(text: str) -> str:
    """The document with the table as the page has it."""
    metrics = json.loads(SOURCE.read_text(encoding="utf-8"))
    rows = [f"| `{name}` | {one['meaning']} | {one['good']} |" for name, one in metrics.items()]
    table = "\n".join(["| Metric | Meaning | Good |", "|---|---|---|", *rows])
    return _PLACE.sub(lambda found: f"{found[1]}{table}\n\n{found[2]}", text)


if __name__ == "__main__":
    TARGET.write_text(with_table(TARGET.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"wrote the metrics into {TARGET.name}")
