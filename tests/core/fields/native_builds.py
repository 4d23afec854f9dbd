"""The native library for the tests: the checkout's own where it is up to date, else one built in a scratch folder."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest

from regnf_core.native.library import LIBRARY, Library, Variant, load
from scripts.native_library import NAME, NotBuiltError, build, sources_digest

SOURCES = LIBRARY.parent


@cache
def library() -> Library:
    """Of the present C files. Skips the test where none can be built."""
    if load().sources == sources_digest(SOURCES):
        return load()
    target = Path(mkdtemp(prefix="regnf-native-")) / NAME
    try:
        build(SOURCES, target)
    except NotBuiltError as error:
        pytest.skip(f"no native evaluator: {error}")
    return load(target)


def variants() -> tuple[Variant, ...]:
    """All that this processor runs, the slow one for every processor too."""
    found = library().variants
    assert found, library().fault
    return found
