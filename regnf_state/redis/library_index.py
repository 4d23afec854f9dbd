"""Where the entries of callers' libraries are listed in Redis.

Keys:  regnf:owner:{owner}:library                sorted by time: references of the fields that are entries
       regnf:owner:{owner}:library:{sha256}       the reference of the field whose entry has the name with this digest
"""

from __future__ import annotations

import hashlib

from regnf_state.records import FieldRecord
from regnf_state.redis.documents import Command
from regnf_state.redis.keys import PREFIX


def listed_key(owner: str) -> str:
    """An owner's entries by the time that they were added."""
    return f"{PREFIX}owner:{owner}:library"


def name_key(owner: str, name: str) -> str:
    """Which field of an owner has an entry of this name."""
    return f"{listed_key(owner)}:{hashlib.sha256(name.encode()).hexdigest()}"


def listed(record: FieldRecord) -> list[Command]:
    """What lists the entry of a field, if it has one."""
    if record.library is None:
        return [("ZREM", listed_key(record.owner), record.sha256)]
    return [
        ("SET", name_key(record.owner, record.library["name"]), record.sha256),
        ("ZADD", listed_key(record.owner), repr(float(record.library["added"])), record.sha256),
    ]


def unlisted(record: FieldRecord) -> list[Command]:
    """What takes the entry of a field out of the lists."""
    if record.library is None:
        return []
    return [
        ("DEL", name_key(record.owner, record.library["name"])),
        ("ZREM", listed_key(record.owner), record.sha256),
    ]
