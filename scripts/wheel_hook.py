"""Build hook of hatchling: a wheel carries the demo's files and the manual's pages, which exist once in a checkout.

An editable install gets none: it runs from the checkout and reads them there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDERS = ("start", "how-to", "concepts")
FILES = ("mix-room.safetensors", "armchair.safetensors", "detection.json", "truth.json")


class PackagedFilesHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds regnf_cli/demo_files and regnf_cli/manual_pages to a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version != "editable":
            build_data["force_include"].update(
                {f"examples/data/{name}": f"regnf_cli/demo_files/{name}" for name in FILES}
                | {f"docs/{name}": f"regnf_cli/manual_pages/{name}" for name in pages(Path(self.root))}
            )


def pages(root: Path) -> list[str]:
    """The manual's pages in the checkout ``root``: those for users."""
    docs = root / "docs"
    found = [docs.glob("*.md"), *(docs.glob(f"{folder}/*.md") for folder in FOLDERS)]
    return sorted(path.relative_to(docs).as_posix() for paths in found for path in paths)
