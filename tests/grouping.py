"""How `--dist loadgroup` spreads the tests over processes: what stays together, and what begins first.

A file's tests run in one process, so that what they share is made once. Some folders are one group: their processes
have deadlines, and only one of them at a time shall have the machine, or they share a browser and a service. Files that
are long and share nothing are taken apart. A mark `xdist_group` of a test's own goes before all that.
"""

from __future__ import annotations

from pathlib import Path

import pytest

_TESTS = Path(__file__).parent
_TOGETHER = ("faults", "serve", "ui")
_APART = ("core/fields/test_onnx.py",)
_FIRST = ("faults", "ui", "live", "serve", "packaging", "contract/test_fuzz.py")
"""The longest groups, longest first: whoever began with one of them last would keep the others waiting."""


def group_of(path: Path) -> str | None:
    """The group of a file's tests; None: each test by itself."""
    name = path.relative_to(_TESTS).as_posix()
    folder = name.partition("/")[0]
    if folder in _TOGETHER:
        return folder
    return None if name in _APART else name


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("loadgroup", False):
        return
    places = {}
    for item in items:
        mark = item.get_closest_marker("xdist_group")
        group = mark.args[0] if mark else group_of(item.path)
        if group is not None and mark is None:
            item.add_marker(pytest.mark.xdist_group(group))
        places[item] = _FIRST.index(group) if group in _FIRST else len(_FIRST)
    items.sort(key=lambda item: places[item])
