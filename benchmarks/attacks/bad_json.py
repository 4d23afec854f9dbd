"""Bodies that are nearly a sound JSON request: members changed, values of every kind, text that is no JSON at all."""

from __future__ import annotations

import copy
import json
from random import Random
from typing import Any

_VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1e308,
    10**400,
    -(2**63),
    0.1,
    "",
    "a" * 5000,
    "\u0000",
    "\u2028",
    "\u202e",
    "0" * 64,
    [],
    {},
    [[[[]]]],
    [0] * 3000,
    {"field": None},
    {"url": "http://127.0.0.1/"},
    {"url": "http://[::ffff:10.0.0.1]/"},
)
_BROKEN = (
    b"",
    b"null",
    b"[]",
    b'"x"',
    b"{",
    b"[" * 100_000,
    b'{"a":' * 20_000,
    b'{"a": NaN}',
    b'{"a": Infinity}',
    b'{"seed": 1, "seed": 2}',
    b"\xff\xfe{\x00}\x00",
    b"\xef\xbb\xbf{}",
    b'{"a": "\xed\xa0\x80"}',
    b'{"a": "\\ud800"}',
    b'{"a": 1e999999999}',
    b'{"a": ' + b"9" * 60_000 + b"}",
    b"{" + b",".join(b'"%d":0' % n for n in range(60_000)) + b"}",
    b"[" + b"0," * 300_000 + b"0]",
    b'{"options": {' + b",".join(b'"o%d":{}' % n for n in range(20_000)) + b"}}",
)


def bad_body(random: Random, sound: dict[str, Any]) -> bytes:
    """One body; a third of them are no JSON documents of an object."""
    if random.random() < 0.33:
        return random.choice(_BROKEN)
    document = copy.deepcopy(sound)
    for _ in range(random.randrange(1, 4)):
        _change(random, document)
    data = json.dumps(document).encode()
    if random.random() < 0.2:
        at = random.randrange(len(data))
        data = data[:at] + random.randbytes(random.randrange(1, 4)) + data[at + 1 :]
    return data


def _change(random: Random, document: dict[str, Any]) -> None:
    """Change, remove, rename or add one member, at a random depth."""
    place: Any = document
    while isinstance(place, dict) and place and random.random() < 0.6:
        inner = random.choice(list(place.values()))
        if not isinstance(inner, dict) or not inner:
            break
        place = inner
    name = random.choice(list(place)) if place else "a"
    match random.randrange(5):
        case 0:
            place[name] = random.choice(_VALUES)
        case 1:
            place.pop(name, None)
        case 2:
            place[f"{name}{random.choice(['x', ' ', chr(0), 's' * 300])}"] = place.get(name)
        case 3:
            place[random.choice(["options", "webhook", "ground_truth", "candidates", "initial_transform", "label"])] = (
                random.choice(_VALUES)
            )
        case _:
            place[random.choice(["__proto__", "constructor", "$ref", "id", "owner", "status", "attempt"])] = name
