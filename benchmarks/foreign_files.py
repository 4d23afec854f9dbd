"""Files of one solid by writers other than regnf's, read in the confined process and compared with the solid.

    python -m benchmarks.foreign_files --output benchmarks/results/foreign_files.md

Only this benchmark needs the writers: pip install plyfile meshio numpy-stl pygltflib lib3mf pymeshlab pyvista
pyvista-validation cadquery-ocp, beside regnf[cad]; what is not installed is skipped. The solid, a union of boxes, has
no symmetry: a mirrored, turned, scaled or inverted file is told from a right one, which has the true surface within 1 %
(clouds) or .01 % (meshes) of the diagonal, and every box's middle on its side.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import torch

from benchmarks.foreign_writers import EDGES, FULL, POINTS, WRITERS, File, V
from regnf_core.errors import RegnfError
from regnf_core.field_source import find_source
from regnf_core.loading import load_field

_MESH, _CLOUD = 1e-4, 0.01
"""Shares of the diagonal."""


def judged(file: File, cache: Path) -> str:
    """ "right", "misread: ..." or "refused: ..."."""
    try:
        read = load_field(find_source(file.path), cache_dir=cache).field
    except RegnfError as error:
        return f"refused: `{error.reason}` {str(error).rpartition(file.path.name + ': ')[2].split(';')[0][:60]}"
    cells = list(np.ndindex(*(len(edge) - 1 for edge in EDGES)))
    middles = np.array([[edge[at : at + 2].mean() for edge, at in zip(EDGES, cell, strict=True)] for cell in cells])
    at = torch.from_numpy(file.scale * np.concatenate([POINTS, middles]))
    distance = read.signed_distance(at).double().numpy() / file.scale
    off = float(np.quantile(np.abs(distance[: len(POINTS)]), 0.95) / np.linalg.norm(np.ptp(V, axis=0)))
    wrong = sum((value < 0.0) != (cell in FULL) for value, cell in zip(distance[len(POINTS) :], cells, strict=True))
    if off <= (_CLOUD if file.is_cloud else _MESH) and not wrong:
        return "right"
    return f"misread: {100 * off:.2g} % off, {wrong} of {len(cells)} sides"


def named(package: str) -> str:
    for name in (package, f"{package}-cpu"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            return f"{name} {importlib.metadata.version(name)}"
    return package


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--only", nargs="*", default=list(WRITERS))
    arguments = parser.parse_args()
    found: dict[tuple[str, str], list[str]] = defaultdict(list)
    skipped = []
    with tempfile.TemporaryDirectory() as made:
        for writer in arguments.only:
            folder = Path(made) / writer
            folder.mkdir()
            try:
                for file in WRITERS[writer](folder):
                    found[file.path.suffix[1:], named(writer)].append(judged(file, Path(made) / "cache"))
                    print(writer, file.path.name, found[file.path.suffix[1:], named(writer)][-1], flush=True)
            except ImportError:
                skipped.append(writer)
    total = Counter(result.partition(":")[0] for results in found.values() for result in results)
    text = "# Files by other writers\n\n`python -m benchmarks.foreign_files`: "
    text += f"{total.total()} files of {len({key[0] for key in found})} endings by {len({key[1] for key in found})} "
    text += f"writers: {total['right']} right, {total['refused']} refused by name, {total['misread']} misread. "
    text += f"Skipped, not installed: {', '.join(skipped) or 'none'}.\n\n"
    text += "| ending | writer and version | files | right | refused by name | misread | why |\n" + "|---" * 7 + "|\n"
    for (ending, writer), results in sorted(found.items()):
        counts = [str(sum(one.startswith(kind) for one in results)) for kind in ("right", "refused", "misread")]
        why = "; ".join(dict.fromkeys(one.partition(": ")[2] for one in results if one != "right"))
        text += f"| {ending} | {writer} | {len(results)} | {' | '.join(counts)} | {why} |\n"
    print(text)
    if arguments.output is not None:
        arguments.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
