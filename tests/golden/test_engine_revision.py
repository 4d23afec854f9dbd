"""The engine's revision cannot be forgotten: its code has a digest, and its results are recorded."""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path

import pytest

from regnf_core.version import ENGINE_REVISION
from scripts.engine_revision import ROOT, changes_since, next_record, write_revision
from scripts.engine_sources import engine_modules, source_digest
from tests.golden.cases import cases
from tests.golden.records import Recorded

GOLDEN = {case.name: case for case in cases()}


def test_changed_code_was_followed_by_a_look_at_the_results() -> None:
    recorded = Recorded.load()
    assert source_digest(ROOT) == recorded.sources, "the engine's code has changed: python -m scripts.engine_revision"
    assert recorded.revision == ENGINE_REVISION, "raise the revision by python -m scripts.engine_revision alone"


def test_the_same_results_refresh_the_digest_and_keep_the_values() -> None:
    recorded, name = Recorded.load(), "robust-any-orientation"
    found = copy.deepcopy(recorded.results)
    found[name]["T_object_scene"][0][3] += 1e-8  # another processor
    changes = changes_since(recorded, GOLDEN, found)
    assert changes == []
    assert next_record(recorded, found, "new", changes, raised=False) == Recorded(
        recorded.revision, "new", recorded.results
    )


def test_other_results_raise_the_revision_and_are_recorded() -> None:
    recorded, name = Recorded.load(), "robust-any-orientation"
    found = copy.deepcopy(recorded.results)
    found[name]["verdict"] = "rejected"
    changes = changes_since(recorded, GOLDEN, found)
    assert changes == [f"{name}: verdict registered -> rejected"]
    assert next_record(recorded, found, "new", changes, raised=False) == Recorded(recorded.revision + 1, "new", found)
    assert next_record(recorded, recorded.results, "new", [], raised=True).revision == recorded.revision + 1


def test_a_new_case_changes_no_result_and_a_lost_one_does() -> None:
    recorded = Recorded.load()
    fewer = Recorded(3, "old", {name: one for name, one in recorded.results.items() if name != "library-search"})
    assert changes_since(fewer, GOLDEN, recorded.results) == []
    assert set(next_record(fewer, recorded.results, "new", [], raised=False).results) == set(GOLDEN)
    golden = {name: case for name, case in GOLDEN.items() if name != "library-search"}
    assert changes_since(recorded, golden, fewer.results) == ["library-search: no longer a case"]


def test_the_revision_is_written_where_it_is_read(tmp_path: Path) -> None:
    module = tmp_path / "engine_revision.py"
    module.write_text('"""Text."""\n\nENGINE_REVISION = 41\n', encoding="utf-8")
    write_revision(42, module)
    assert module.read_text(encoding="utf-8") == '"""Text."""\n\nENGINE_REVISION = 42\n'
    module.write_text("OTHER = 41\n", encoding="utf-8")
    with pytest.raises(ValueError, match="ENGINE_REVISION"):
        write_revision(42, module)


# The digest of the engine's code: what changes it, and what does not.


ENTRY = ("core.start",)
START = '''"""Where it starts."""
from __future__ import annotations

from typing import TYPE_CHECKING

from core.parts.shape import area, edge

if TYPE_CHECKING:
    from core.parts.kinds import Kind


def run(kind: Kind) -> float:
    """The answer."""
    import core.late

    return area(2.0) + edge() + core.late.LATE  # a comment
'''
FILES = {
    "core/__init__.py": "",
    "core/start.py": START,
    "core/late.py": 'LATE = 1\n"""What comes late."""\nTABLE = {"shape": "core.parts.table"}\n',
    "core/unused.py": "import nothing_that_exists\n",
    "core/parts/__init__.py": "",
    "core/parts/kinds.py": "class Kind: ...\n",
    "core/parts/shape.py": "import math\n\n\ndef area(r): return math.pi * r * r\n\n\ndef edge(): return 4\n",
    "core/parts/table.py": "WIDTH = 0.5\n",
    "core/parts/other.py": "def area(r): return r\n\n\ndef edge(): return 5\n",
}


def tree(root: Path, **changed: str) -> Path:
    for name, text in (FILES | {name.replace("__", "/") + ".py": text for name, text in changed.items()}).items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return root


@pytest.fixture
def before(tmp_path: Path) -> str:
    return source_digest(tree(tmp_path / "before"), ENTRY)


def test_every_import_is_followed_but_those_of_type_checkers(tmp_path: Path) -> None:
    found = engine_modules(tree(tmp_path), ENTRY)
    assert set(found) == {"core.start", "core.parts.shape", "core.late", "core.parts.table"}


def test_comments_docstrings_and_unused_modules_do_not_count(tmp_path: Path, before: str) -> None:
    after = tree(
        tmp_path / "after",
        core__start=START.replace("The answer.", "Another sentence.").replace("  # a comment", ""),
        core__late=FILES["core/late.py"].replace("What comes late.", "Another sentence."),
        core__unused="LATE = 2\n",
        core__parts__kinds="class Kind(int): ...\n",
    )
    assert source_digest(after, ENTRY) == before


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("core/start.py", "area(2.0)", "area(2.5)"),
        ("core/late.py", "LATE = 1", "LATE = 2"),
        ("core/parts/table.py", "0.5", "0.25"),
        ("core/parts/shape.py", "r * r", "r + r"),
        ("core/parts/shape.py", "import math", "import cmath as math"),
        ("core/start.py", "import area, edge", "import area as edge, edge as area"),
    ],
)
def test_code_counts_wherever_it_is(tmp_path: Path, before: str, module: str, old: str, new: str) -> None:
    after = tree(tmp_path / "after")
    text = FILES[module]
    assert old in text
    (after / module).write_text(text.replace(old, new), encoding="utf-8")
    assert source_digest(after, ENTRY) != before


def test_c_files_beside_a_module_count_but_for_their_comments(tmp_path: Path, before: str) -> None:
    first, second, third = (tree(tmp_path / name) for name in ("first", "second", "third"))
    (first / "core/parts/shape.c").write_text("/* one */ int sides = 4;\n", encoding="utf-8")
    (second / "core/parts/shape.c").write_text("int  sides = 4; /* another,\n of two lines */\n", encoding="utf-8")
    (third / "core/parts/shape.c").write_text("int sides = 5;\n", encoding="utf-8")
    digests = [source_digest(root, ENTRY) for root in (first, second, third)]
    assert digests[0] == digests[1]
    assert len({before, *digests}) == 3


def test_a_module_may_be_moved(tmp_path: Path, before: str) -> None:
    after = tree(tmp_path / "after", core__start=START.replace("core.parts.shape", "core.geometry"))
    (after / "core/parts/shape.py").rename(after / "core/geometry.py")
    assert source_digest(after, ENTRY) == before


def test_a_function_of_the_same_name_from_elsewhere_counts(tmp_path: Path) -> None:
    both = "from core.parts.other import area as a, edge as e\n"
    first = tree(tmp_path / "first", core__start=both + START)
    second = tree(
        tmp_path / "second",
        core__start=both.replace("other", "shape") + START.replace("core.parts.shape", "core.parts.other"),
    )
    assert source_digest(first, ENTRY) != source_digest(second, ENTRY)


def test_what_cannot_be_followed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="relative import"):
        source_digest(tree(tmp_path, core__start="from . import late\n"), ENTRY)
    with pytest.raises(FileNotFoundError):
        source_digest(tmp_path, ("core.nowhere",))


def test_all_that_a_registration_loads_is_in_the_digest() -> None:
    """A module that no import names, for instance one found by a text put together, would be missed."""
    code = (
        "import sys, regnf_core.batch, regnf_core.library\n"
        "from regnf_core.geometry.box import OrientedBox\n"
        "from regnf_core.library import register\n"
        "from regnf_core.fields.build import open_field\n"
        "scene, chair = (open_field(f'examples/data/{name}.safetensors') for name in ('mix-room', 'armchair'))\n"
        "register(scene, chair, OrientedBox.from_corners([-0.83, -0.58, -0.5], [-0.29, 0.01, 0.01]))\n"
        "print(*(name for name in sys.modules if name.startswith('regnf_core')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    engine = engine_modules(ROOT)
    missed = {name for name in done.stdout.split() if name not in engine}
    packages = {name for name in missed if ROOT.joinpath(*name.split("."), "__init__.py").exists()}
    assert missed - packages <= {"regnf_core.version"}
    assert len([name for name in engine if "fields" in name]) >= 15, "every kind of field"
    assert len(engine) > 50


def test_data_beside_the_engines_modules_count(tmp_path: Path, before: str) -> None:
    root = tree(tmp_path / "after")
    data = root / "core" / "parts" / "numbers.json"
    data.write_text('{"weight": 1.5}', encoding="utf-8")
    first = source_digest(root, ENTRY)
    assert first != before
    data.write_text('{ "weight":  1.5 }\n', encoding="utf-8")
    assert source_digest(root, ENTRY) == first  # how it is written says nothing
    data.write_text('{"weight": 1.6}', encoding="utf-8")
    assert source_digest(root, ENTRY) not in (first, before)
