"""Build hook of hatchling: a wheel carries the demo's files and the manual's pages, which exist once in a checkout, and
the native evaluator.

An editable install gets none of the files: it runs from the checkout and reads them there, and the evaluator is built
there. Where it cannot be built the wheel is one for every platform, and regnf evaluates with torch.
"""

from __future__ import annotations

import importlib.util
import shutil
import sysconfig
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDERS = ("start", "how-to", "concepts")
FILES = ("mix-room.safetensors", "armchair.safetensors", "detection.json", "truth.json")


class PackagedFilesHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds regnf_cli/demo_files, regnf_cli/manual_pages and the native evaluator to a wheel."""

    _scratch: str | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = Path(self.root)
        if version == "editable":
            native = native_library(root)
            self._build(native, root / native.FOLDER / native.NAME)
            return
        build_data["force_include"].update(
            {f"examples/data/{name}": f"regnf_cli/demo_files/{name}" for name in FILES}
            | {f"docs/{name}": f"regnf_cli/manual_pages/{name}" for name in pages(root)}
        )
        native = native_library(root)
        self._scratch = tempfile.mkdtemp(prefix="regnf-native-")
        made = Path(self._scratch) / native.NAME
        if self._build(native, made):
            build_data["force_include"][str(made)] = f"{native.FOLDER.as_posix()}/{native.NAME}"
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{platform_tag()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def _build(self, native: ModuleType, target: Path) -> bool:
        try:
            native.build(Path(self.root) / native.FOLDER, target)
        except native.NotBuiltError as error:
            self.app.display_warning(f"No native evaluator ({error}): fields are evaluated with torch.")
            return False
        return True


def native_library(root: Path) -> ModuleType:
    """scripts/native_library.py: this file is run where its folder is not in the path."""
    spec = importlib.util.spec_from_file_location("native_library", root / "scripts" / "native_library.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def platform_tag() -> str:
    """Of a wheel with code for this machine, as in linux_x86_64: it promises nothing of other C libraries."""
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")


def pages(root: Path) -> list[str]:
    """The manual's pages in the checkout ``root``: those for users."""
    docs = root / "docs"
    found = [docs.glob("*.md"), *(docs.glob(f"{folder}/*.md") for folder in FOLDERS)]
    return sorted(path.relative_to(docs).as_posix() for paths in found for path in paths)
