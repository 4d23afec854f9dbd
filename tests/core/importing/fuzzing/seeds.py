"""The sound files from which every case begins. Making them needs torch; using them does not."""

from __future__ import annotations

import pickle
from collections import OrderedDict, defaultdict
from dataclasses import dataclass
from pathlib import Path

from regnf_core.importing.containers.legacy_container import read_archive
from tests.core.importing.fuzzing.archive_model import Record, archive_bytes

EMPTY = "90"
"""Key of a storage without a byte."""


@dataclass(frozen=True, repr=False)
class Seeds:
    """A small checkpoint taken apart, the field file it becomes, and pickles of other kinds."""

    records: tuple[Record, ...]
    pickles: tuple[bytes, ...]
    tensors: tuple[tuple[str, str, tuple[int, ...]], ...]
    """Name, storage key and shape of each tensor of the checkpoint's field."""
    field_file: bytes
    others: dict[str, dict[str, bytes]]
    """Sound files of other kinds, by the stage that begins with them."""

    @property
    def other_files(self) -> dict[str, bytes]:
        """All of ``others``."""
        return {f"{stage} {kind}": data for stage, files in self.others.items() for kind, data in files.items()}

    @property
    def archive(self) -> bytes:
        return archive_bytes(list(self.records))

    def with_pickle(self, body: bytes, storages: dict[str, bytes] | None = None) -> bytes:
        """The checkpoint's archive with another pickle, and some storages replaced."""
        changed = {"data.pkl": body} | {f"data/{key}": data for key, data in (storages or {}).items()}
        swapped = (Record(r.name, changed.get(r.name.decode().partition("/")[2], r.data)) for r in self.records)
        return archive_bytes(list(swapped))

    def save(self, path: Path) -> None:
        """Write them where a process without torch finds them."""
        path.write_bytes(pickle.dumps(self))


def load_seeds(path: Path) -> Seeds:
    """What ``Seeds.save`` wrote; the file is our own."""
    seeds: Seeds = pickle.loads(path.read_bytes())
    return seeds


def make_seeds(folder: Path) -> Seeds:
    """Fresh seeds; the same each time."""
    import numpy as np
    import torch

    from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
    from regnf_core.importing.gate.report import ImportLimits
    from tests.core.importing.checkpoints import checkpoint
    from tests.core.importing.fuzzing.other_files import make_others

    values = checkpoint(log2_size=8, hidden=6, optimizer=False)
    upload = folder / "seed.ckpt"
    torch.save(values, upload)
    convert_file(upload, folder, None, ImportLimits())
    archive = read_archive(memoryview(upload.read_bytes()))
    records = tuple(Record(b"archive/" + name.encode(), bytes(archive.read(name))) for name in archive.entries)
    records += (Record(f"archive/data/{EMPTY}".encode(), b""),)
    odd: dict[str, object] = {
        "n": None,
        "t": (1, 2.5, "x", b"y"),
        "l": [1] * 3,
        "o": OrderedDict(a={1: 2}),
        "d": defaultdict(list, k=[1]),
    }
    odd |= {"s": np.float64(2.0), "i": np.int32(3), "set": {1, 2}, "f": frozenset("ab"), "big": 1 << 70, "path": folder}
    pickles = [bytes(archive.read("data.pkl")), *(pickle.dumps(odd, protocol) for protocol in (2, 4, 5))]
    seeds = Seeds(records, tuple(pickles), _tensors_of(pickles[0]), (folder / FIELD_NAME).read_bytes(), make_others())
    upload.unlink()
    (folder / FIELD_NAME).unlink()
    return seeds


def _tensors_of(body: bytes) -> tuple[tuple[str, str, tuple[int, ...]], ...]:
    from regnf_core.importing.pickle.pickle_machine import TensorRef
    from regnf_core.importing.pickle.pickle_reader import read_pickle

    state = read_pickle(memoryview(body))["pipeline"]
    refs = {name: ref for name, ref in state.items() if isinstance(ref, TensorRef) and name.startswith("_model.field.")}
    return tuple((name, ref.storage.key, ref.shape) for name, ref in refs.items())
