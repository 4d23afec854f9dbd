"""The kinds of field that the safe format holds: one module a kind, listed in ``KINDS``. Torch-free.

docs/families.md tells how to add one.
"""

from __future__ import annotations

from regnf_core.fields.kinds.kind import FieldDescription
from regnf_core.fields.kinds.neus_facto import NeusFactoDescription

KINDS: dict[str, type[FieldDescription]] = {
    "neus_facto": NeusFactoDescription,
}
"""By the description's ``family``."""
