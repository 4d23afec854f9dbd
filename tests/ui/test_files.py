"""The page's files by themselves: nothing inline, nothing foreign, nothing missing. Needs no browser."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest

from tests.ui.stories import WEB


def test_files_hold_no_inline_code_and_no_foreign_address() -> None:
    for path in WEB.glob("*.html"):
        assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son\w+=", path.read_text()), path.name
    for path in [*WEB.glob("*.html"), *(WEB / "js").glob("*.js"), *(WEB / "css").glob("*.css")]:
        foreign = set(re.findall(r"https?://[^\s'\"]+", path.read_text())) - {"http://www.w3.org/2000/svg"}
        assert not foreign, path.name
    assert "innerHTML" not in "".join(path.read_text() for path in (WEB / "js").glob("*.js"))


def test_vendored_bundle_is_the_noted_one() -> None:
    digest = hashlib.sha256((WEB / "vendor" / "three.bundle.min.js").read_bytes()).hexdigest()
    assert f"`{digest}`" in (WEB / "vendor" / "README.md").read_text()
    root = Path(__file__).resolve().parents[2]
    script = (root / "scripts" / "vendor_three.sh").read_text()
    named = re.findall(r"service[\w./]*/vendor\b", script)
    assert named
    assert {(root / name).resolve() for name in named} == {(WEB / "vendor").resolve()}


@pytest.mark.parametrize("page", [path.name for path in WEB.glob("*.html")])
def test_every_import_and_every_id_exists(page: str) -> None:
    text = (WEB / page).read_text()
    ids = set(re.findall(r'\bid="([^"]+)"', text))
    (first,) = re.findall(r'<script type="module" src="/static/js/([^"]+)"', text)
    open_, seen = [WEB / "js" / first], set()
    while open_:
        path = open_.pop().resolve()
        if path in seen or path.parent.name == "vendor":
            continue
        seen.add(path)
        source = path.read_text()
        for target in re.findall(r"from '(\.[^']+)'", source):
            assert (path.parent / target).is_file(), f"{path.name}: {target}"
            open_.append(path.parent / target)
        assert set(re.findall(r"byId\('([^']+)'\)", source)) <= ids, path.name
    assert len(seen) > 2
