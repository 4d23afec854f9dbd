"""The native evaluator's build: with a compiler, without one, and what a wheel and an installation are like then."""

from __future__ import annotations

import shutil
from pathlib import Path
from zipfile import ZipFile

import pytest
import torch

from regnf_core import open_field
from regnf_core.native import library
from scripts import native_library, wheel_hook
from scripts.native_library import NAME, NotBuiltError, build, sources_digest
from tests.packaging.environments import ROOT, build_wheel

pytestmark = pytest.mark.xdist_group("packaging")
SOURCES = ROOT / native_library.FOLDER


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("built") / NAME
    try:
        build(SOURCES, path)
    except NotBuiltError as error:
        pytest.skip(f"no native evaluator: {error}")
    return path


@pytest.fixture
def built(compiled: Path, tmp_path: Path) -> Path:
    """A copy of what is compiled once."""
    return shutil.copy(compiled, tmp_path / NAME)


def test_the_checkouts_own_library_is_of_these_sources() -> None:
    found = library.load()
    if found.fault == library.NOT_BUILT:
        pytest.skip("there is none")
    assert found.sources == sources_digest(SOURCES), "run scripts/setup.sh"


def test_what_is_built_loads_and_is_not_built_twice(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = library.load(built)
    assert found.variants[-1].name == "plain"
    assert found.sources == sources_digest(SOURCES)
    before = built.stat().st_ino
    build(SOURCES, built)
    assert built.stat().st_ino == before
    assert [path.name for path in built.parent.iterdir()] == [NAME]
    other = built.rename(built.with_name("other.so"))
    monkeypatch.setattr(library, "_LAYOUT", 0)
    assert library.load(other).fastest is None, "it is of another layout"


def test_a_library_of_older_sources_goes(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built.write_bytes(built.read_bytes().replace(sources_digest(SOURCES).encode(), b"0" * 64))
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.delenv("REGNF_NATIVE", raising=False)
    with pytest.raises(NotBuiltError, match="no-such-compiler"):
        build(SOURCES, built)
    assert not built.exists()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("REGNF_NATIVE", "0", "REGNF_NATIVE is 0"), ("CC", "false", "failed"), ("PATH", "/nowhere", "no C compiler")],
)
def test_without_a_compiler_there_is_a_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str, said: str
) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("REGNF_NATIVE", raising=False)
    monkeypatch.setenv(name, value)
    with pytest.raises(NotBuiltError, match=said):
        build(SOURCES, tmp_path / NAME)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_library_is_not_used_nor_any_by_the_switch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert library.load(tmp_path / "none.so").fault == library.NOT_BUILT
    (tmp_path / "text.so").write_text("not code")
    found = library.load(tmp_path / "text.so")
    assert (found.variants, found.fastest) == ((), None)
    assert "does not load" in str(found.fault)
    monkeypatch.setenv(library.SWITCH, "0")
    assert library.variant() is None
    monkeypatch.delenv(library.SWITCH)
    assert library.variant() is library.load().fastest


def test_fields_are_evaluated_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    field = open_field(ROOT / "examples" / "data" / "mix-room.safetensors")
    low, high = field.bounds.float()
    points = low + torch.rand(100, 3, generator=torch.Generator().manual_seed(1)) * (high - low)
    value, gradient = field.signed_distance_and_gradient(points)
    monkeypatch.setattr(library, "load", lambda: library.Library(fault=library.NOT_BUILT))
    assert library.variant() is None
    found, slope = field.signed_distance_and_gradient(points)
    torch.testing.assert_close(found, value, rtol=0, atol=2e-6)
    torch.testing.assert_close(slope, gradient, rtol=0, atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("switch", ["0", "1"])
def test_a_wheel_is_for_every_platform_unless_it_has_the_library(
    built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, switch: str
) -> None:
    monkeypatch.setenv("REGNF_NATIVE", switch)
    wheel = build_wheel(tmp_path / "wheel")
    with ZipFile(wheel) as archive:
        libraries = [name for name in archive.namelist() if name.endswith(".so")]
    expected = [] if switch == "0" else [f"{native_library.FOLDER.as_posix()}/{NAME}"]
    tag = "any" if switch == "0" else wheel_hook.platform_tag()
    assert (libraries, wheel.stem.split("-", 2)[2]) == (expected, f"py3-none-{tag}")
