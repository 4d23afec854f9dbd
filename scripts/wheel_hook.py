"""Build hook of hatchling: a wheel carries the demo's files, which exist once in a checkout, in examples/data.

An editable install gets none: it runs from the checkout and reads them there.
"""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FILES = ("mix-room.safetensors", "armchair.safetensors", "detection.json", "truth.json")


class DemoFilesHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds regnf_cli/demo_files to a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version != "editable":
            build_data["force_include"].update(
                {f"examples/data/{name}": f"regnf_cli/demo_files/{name}" for name in FILES}
            )
