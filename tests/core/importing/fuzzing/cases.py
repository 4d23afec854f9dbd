"""From a random number generator to one case of a stage."""

from __future__ import annotations

from random import Random

from tests.core.importing.archives import tensor, text
from tests.core.importing.fuzzing.archive_model import Ending, archive_bytes, lied
from tests.core.importing.fuzzing.byte_mutations import damaged
from tests.core.importing.fuzzing.container_mutations import SPOILERS
from tests.core.importing.fuzzing.header_mutations import rewritten
from tests.core.importing.fuzzing.pickle_grammar import Grammar, contiguous, opcodes_of, respelt
from tests.core.importing.fuzzing.seeds import EMPTY, Seeds

STAGES = ("container", "pickle", "tensors", "header", "file", *SPOILERS)
"""container: any bytes as an archive. pickle: any bytes as a pickle. tensors: an archive that is sound but for its
pickle and storages, up to the field. header: any bytes as a safetensors file. file: any bytes as an upload. legacy,
arrays, database, mesh, onnx: a file of that container, damaged, as an upload; other: so other trainers' checkpoints;
run: so an archive of a run. settings: a file of settings behind a line with its name."""

_LEGACY = bytes.fromhex("80028a0a6cfc9c46f9206aa850192e")


def make_case(random: Random, stage: str, seeds: Seeds, finds: list[bytes]) -> bytes:
    """One case. ``finds`` are earlier cases of the stage that reached new code: some cases build upon them."""
    if finds and random.random() < 0.4:
        return damaged(random, random.choice(finds), random.choice(finds))
    make = {"container": _container, "pickle": _pickle, "tensors": _tensors, "header": _header}.get(stage)
    if make is None and stage in SPOILERS:
        files = list(seeds.others[stage].values())
        return SPOILERS[stage](random, random.choice(files), random.choice(files))
    make = make or random.choice((_container, _tensors, _tensors, _header, _header, _head))
    return make(random, seeds)


def _container(random: Random, seeds: Seeds) -> bytes:
    records = list(seeds.records)
    random.shuffle(records)
    records = records[: random.randrange(1, 8)] if random.random() < 0.5 else records
    if random.random() < 0.25:
        return damaged(random, archive_bytes(records), seeds.archive)
    changed, ending = lied(random, records, Ending(wide=random.random() < 0.2))
    return archive_bytes(changed, ending)


def _pickle(random: Random, seeds: Seeds) -> bytes:
    first, second = random.choice(seeds.pickles), random.choice(seeds.pickles)
    if random.random() < 0.5:
        grammar = Grammar(random)
        return grammar.pickle(grammar.value(6))
    if random.random() < 0.5:
        return damaged(random, first, second)
    return respelt(random, opcodes_of(first), opcodes_of(second))


def _tensors(random: Random, seeds: Seeds) -> bytes:
    storages = {}
    if random.random() < 0.2:
        _, key, _ = random.choice(seeds.tensors)
        storages[key] = random.choice((b"", b"\0" * 24, b"\xff" * 24, random.randbytes(random.randrange(64))))
    if random.random() < 0.25:
        return seeds.with_pickle(respelt(random, opcodes_of(seeds.pickles[0]), opcodes_of(seeds.pickles[1])), storages)
    body = b"".join(_entry(random, *entry) for entry in seeds.tensors)
    return seeds.with_pickle(b"\x80\x02}" + text("pipeline") + b"}(" + body + b"us.", storages)


def _entry(random: Random, name: str, key: str, shape: tuple[int, ...]) -> bytes:
    """One weight, mostly as it should be."""
    strides, offset, count, named = contiguous(shape), 0, None, {}
    if random.random() < 0.12:
        grammar = Grammar(random)
        match random.randrange(9):
            case 0:
                return b""
            case 1:
                name += random.choice((".x", "0", "\u202e"))
            case 2:
                return text(name) + grammar.value(3)
            case 3:
                shape = tuple(grammar.extent() for _ in shape)
            case 4:
                shape = (0, *(grammar.extent() for _ in range(random.randrange(4))))
                strides, key = contiguous(shape), EMPTY
            case 5:
                strides = tuple(grammar.extent() for _ in strides)
            case 6:
                offset, count = random.choice((-1, 1, 1 << 40)), random.choice((None, 0, 1 << 40))
            case 7:
                named = {random.choice(("kind", "device")): random.choice(("HalfStorage", "LongStorage", "meta", "x"))}
            case _:
                return text(name) + b"ctorch._utils\n_rebuild_parameter\n" + tensor(key, shape, strides) + b"\x88}\x87R"
    return text(name) + tensor(key, shape, strides, offset, count, **named)


def _header(random: Random, seeds: Seeds) -> bytes:
    return damaged(random, seeds.field_file) if random.random() < 0.2 else rewritten(random, seeds.field_file)


def _head(random: Random, seeds: Seeds) -> bytes:
    """Something else altogether, or a sound file cut short."""
    magics = (b"\x89PNG\r\n\x1a\n", b"PK\x03\x04", b"\x80\x04", b"ply\n", _LEGACY)
    sound = random.choice((seeds.archive, seeds.field_file, seeds.pickles[0], *magics))
    return random.choice((sound[: random.randrange(600)], random.randbytes(random.choice((0, 1, 7, 600))), sound * 2))
