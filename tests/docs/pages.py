"""The pages of the site that are written for readers, and the code blocks in them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.M | re.S)


@dataclass(frozen=True)
class Block:
    """A fenced block: `python` and `bash` are run, `console` needs a network, ROS or files of the reader's own."""

    language: str
    code: str


def reader_pages() -> list[Path]:
    """Those in which every block is run. The older pages beside them are about the reader's own files."""
    folders = [DOCS / name for name in ("start", "how-to", "concepts", "reference")]
    return sorted(
        [DOCS / "index.md", DOCS / "troubleshooting.md", *(page for folder in folders for page in folder.glob("*.md"))]
    )


def blocks(page: Path) -> list[Block]:
    return [Block(*match) for match in _BLOCK.findall(page.read_text(encoding="utf-8"))]
