"""Which methods an address answers to, by the contract."""

from __future__ import annotations

import re
from typing import Any


def allowed_methods(contract: dict[str, Any], path: str) -> list[str]:
    """The methods that a path answers to, below whatever prefix; none for one the contract does not know."""
    found = set()
    for template, operations in contract["paths"].items():
        pattern = re.sub(r"\\{[^}]+\\}", "[^/]+", re.escape(template))
        if re.fullmatch(f"(/v1)?{pattern}", path):
            found |= {method.upper() for method in operations}
    return sorted(found)
