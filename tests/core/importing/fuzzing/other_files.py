"""One small sound file of every other kind that the gate takes, and damage that knows how such files are built."""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path
from random import Random

from tests.core.importing.fuzzing.archive_model import Ending, Record, archive_bytes, lied
from tests.core.importing.fuzzing.byte_mutations import damaged
from tests.core.importing.fuzzing.pickle_mutations import opcodes_of, respelt


def make_others() -> dict[str, bytes]:
    """The files by their kind. Needs torch and the libraries that write such files."""
    import numpy as np
    import torch
    import trimesh

    from tests.core.importing import onnx_models, small_families, test_nvblox, test_pin_slam, test_voxel_block_grid
    from tests.core.importing.checkpoints import checkpoint

    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    files = {kind: _bytes(ball.export(file_type=kind)) for kind in ("ply", "stl", "stl_ascii", "obj", "glb")}
    files["ply_ascii"] = _bytes(ball.export(file_type="ply", encoding="ascii"))
    axes = np.linspace(-1.0, 1.0, 9)
    distance = np.linalg.norm(np.stack(np.meshgrid(axes, axes, axes, indexing="ij")), axis=0) - 0.5
    files["grid"] = _arrays(sdf=distance.astype(np.float32), bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    files["voxels"] = _arrays(**test_voxel_block_grid.ball())
    files["onnx"] = onnx_models.sphere().SerializeToString()
    files["legacy"] = _saved(torch, checkpoint(log2_size=8, hidden=6, optimiser=False), legacy=True)
    files["pin_slam"] = _saved(torch, test_pin_slam.floor())
    files["sqlite"] = _database(test_nvblox.ball_blocks()[::12])
    for make in (small_families.neus, small_families.siren, small_families.deepsdf, small_families.instant_nsr_pl):
        files[make.__name__] = _saved(torch, make().checkpoint)
    return files


def _bytes(data: bytes | str) -> bytes:
    return data.encode() if isinstance(data, str) else bytes(data)


def _arrays(**arrays: object) -> bytes:
    import numpy as np

    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _database(rows: list[tuple[int, int, int, bytes]]) -> bytes:
    from tests.core.importing import test_nvblox

    with tempfile.TemporaryDirectory() as folder:
        return test_nvblox.write_map(Path(folder, "map"), rows).read_bytes()


def _saved(torch: object, values: object, legacy: bool = False) -> bytes:
    buffer = io.BytesIO()
    torch.save(values, buffer, _use_new_zipfile_serialization=not legacy)  # type: ignore[attr-defined]
    return buffer.getvalue()


def spoilt(random: Random, file: bytes, other: bytes) -> bytes:
    """The file after some damage; of an archive mostly to one entry, which is then packed as if it belonged."""
    if not file.startswith(b"PK\x03\x04") or random.random() < 0.2:
        return damaged(random, file, other)
    with zipfile.ZipFile(io.BytesIO(file)) as archive:
        records = [Record(name.encode(), archive.read(name)) for name in archive.namelist()]
    if random.random() < 0.2:
        return archive_bytes(*lied(random, records, Ending()))
    at = random.randrange(len(records))
    name, data = records[at].name, records[at].data
    if name.endswith(b"data.pkl") and random.random() < 0.7:
        codes = opcodes_of(data)
        records[at] = Record(name, respelt(random, codes, codes))
    else:
        records[at] = Record(name, damaged(random, data, other))
    return archive_bytes(records)
