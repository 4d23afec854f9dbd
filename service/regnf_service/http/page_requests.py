"""Which requests a page answers and which JSON: addresses that people open in a browser have both."""

from __future__ import annotations

import re

from starlette.datastructures import Headers
from starlette.types import Scope

_HOME = re.compile(r"(/v1)?(/|/jobs|/fields|/library)")


def wants_page(scope: Scope) -> bool:
    """Whether the sender would rather have a page than JSON: a browser that opens the address names HTML first."""
    first = Headers(scope=scope).get("accept", "").split(",")[0].partition(";")[0]
    return scope["method"] in ("GET", "HEAD") and first.strip().lower() == "text/html"


def is_home_page(scope: Scope) -> bool:
    """Whether a browser opens one of the addresses of the home page, which holds no data and needs no token."""
    return _HOME.fullmatch(scope["path"]) is not None and wants_page(scope)
