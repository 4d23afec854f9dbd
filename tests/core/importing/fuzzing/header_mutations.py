"""Safetensors files whose header is changed as JSON: values, members, nesting, lengths."""

from __future__ import annotations

import copy
import json
from random import Random
from typing import Any

from tests.core.importing.fuzzing.byte_mutations import NUMBERS, little

_ODD: tuple[Any, ...] = (None, True, -1, 0, 1.5, 1e308, "", "x", "\ud800", "\x00", [], {}, [[]], *NUMBERS, 10**400)
_TYPES = ("F32", "F16", "BF16", "F64", "I64", "BOOL", "F8_E4M3", "f32", "")


def split(file: bytes) -> tuple[dict[str, Any], bytes]:
    """A sound file's header and the bytes behind it."""
    length = int.from_bytes(file[:8], "little")
    header: dict[str, Any] = json.loads(file[8 : 8 + length])
    return header, file[8 + length :]


def joined(random: Random, header: object, body: bytes) -> bytes:
    """The file; now and then with a false length, or a member named twice."""
    raw = json.dumps(header).encode("utf-8")
    if random.random() < 0.1 and raw.endswith(b"}"):
        member = random.choice((b'"layers.0.bias":1', b'"__metadata__":{}', b'"z":' + b"[" * 5000))
        raw = raw[:-1] + b"," + member + b"}"
    raw += b" " * (-(len(raw) + 8) % 64)
    length = random.choice((*NUMBERS, len(raw) - 1, len(raw) + 1)) if random.random() < 0.1 else len(raw)
    return little(length, 8) + raw + body


def rewritten(random: Random, file: bytes) -> bytes:
    """The file after one to three changes to its header, or to the description within."""
    header, body = split(file)
    for _ in range(random.choice((1, 1, 2, 3))):
        if random.random() < 0.4:
            described = json.loads(header["__metadata__"]["field"]) if _is_described(header) else {}
            header.setdefault("__metadata__", {})
            if isinstance(header["__metadata__"], dict):
                header["__metadata__"]["field"] = json.dumps(altered(random, described))
        else:
            header = altered(random, header)
        if not isinstance(header, dict):
            break
    return joined(random, header, body[: random.randrange(len(body) + 1)] if random.random() < 0.1 else body)


def _is_described(header: dict[str, Any]) -> bool:
    metadata = header.get("__metadata__")
    try:
        return isinstance(metadata, dict) and isinstance(json.loads(metadata["field"]), dict)
    except (KeyError, TypeError, ValueError):
        return False


def altered(random: Random, value: Any, most_depth: int = 4) -> Any:
    """``value`` with one of its parts, at any depth, changed, dropped, doubled or renamed."""
    value = copy.deepcopy(value)
    here, depth = value, random.randrange(most_depth + 1)
    while depth and isinstance(here, dict | list) and here:
        below = here[random.choice(list(here))] if isinstance(here, dict) else random.choice(here)
        if not isinstance(below, dict | list) or not below:
            break
        here, depth = below, depth - 1
    if isinstance(here, dict) and here:
        _alter_member(random, here)
    elif isinstance(here, list) and here:
        here[random.randrange(len(here))] = random.choice(_ODD)
    else:
        value = random.choice(_ODD)
    return value


def _alter_member(random: Random, members: dict[str, Any]) -> None:
    key = random.choice(list(members))
    match random.randrange(6):
        case 0:
            del members[key]
        case 1:
            members[random.choice(("x", "\ud800", "a\0", "n" * 300, "hash_table"))] = members.pop(key)
        case 2 if isinstance(members[key], int) and not isinstance(members[key], bool):
            members[key] += random.choice((-1, 1, 4, -4))
        case 3 if key == "dtype":
            members[key] = random.choice(_TYPES)
        case 4:
            members[random.choice(("x", "b"))] = copy.deepcopy(members[key])
        case _:
            members[key] = random.choice(_ODD)
