"""Who owns what. A caller's fields and jobs are its own: no other caller can see, use, count or delete them.

Inside the service a field goes by a reference: the SHA-256 of its bytes and, behind an underscore, its owner's name.
Two callers who send the same bytes therefore have two fields, each with an import, a label and bytes of its own.
Neither can tell, not by an answer and not by how long it takes, what the other has. Outside, a field is its SHA-256.
The fields of a service without tokens belong to ``ANONYMOUS`` and have no owner's name.
"""

from __future__ import annotations

import re

ANONYMOUS = "anonymous"
CALLER_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_SHA256_DIGITS = 64


def reference_of(caller: str, sha256: str) -> str:
    """What the service calls a caller's field. It is a part of blob keys and of queue ids: letters, digits, _ and -."""
    return sha256 if caller == ANONYMOUS else f"{sha256}_{caller}"


def sha256_of(reference: str) -> str:
    """What everyone else calls it."""
    return reference[:_SHA256_DIGITS]


def owner_of(reference: str) -> str:
    """The caller whose field it is."""
    return reference[_SHA256_DIGITS + 1 :] or ANONYMOUS
