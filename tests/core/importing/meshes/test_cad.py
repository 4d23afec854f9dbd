"""STEP models and 3MF packages that other programs wrote, through their readers and through the importer's process."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.mesh_file import load_solid, read_mesh_file
from regnf_core.importing.meshes import read_mesh
from regnf_core.importing.meshes.triangle_files import Geometry
from tests.core.importing.archives import assert_refused, zip_bytes

# Written by OpenCASCADE and lib3mf: scripts/make_cad_files.py says what is in them.
DATA = Path(__file__).parent / "data"
STEP, INCHES, PAIR = (DATA / name for name in ("assembly.step", "inches.step", "pair.3mf"))
CORE = "http://schemas.microsoft.com/3dmanufacturing"
TETRAHEDRON = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/>'
    '<vertex x="0" y="0" z="1"/></vertices><triangles><triangle v1="0" v2="2" v3="1"/><triangle v1="0" v2="1" v3="3"/>'
    '<triangle v1="0" v2="3" v3="2"/><triangle v1="1" v2="2" v3="3"/></triangles></mesh>'
)


def volume(found: Geometry) -> float:
    return float(trimesh.Trimesh(found.vertices, found.faces, process=False).volume)


def box(found: Geometry) -> list[list[float]]:
    corners = found.vertices[found.faces].reshape(-1, 3)
    return [corners.min(axis=0).round(7).tolist(), corners.max(axis=0).round(7).tolist()]


def test_step_is_read_in_meters_and_its_own_axes() -> None:
    found = read_mesh_file(STEP)
    assert box(found) == [[0, 0, 0], [0.1, 0.06, 0.07]]
    mm3 = 100 * 60 * 20 - np.pi * 100 * 20 + 2 * np.pi * 25 * 50 + 4 / 3 * np.pi * 512
    assert volume(found) == pytest.approx(mm3 * 1e-9, rel=2e-3)
    told = "its curved faces are triangles within 0.05 % of its diagonal"
    assert found.notes[1:] == ("the file states millimeter: coordinates were converted to meters", told)
    radius = np.linalg.norm(read_mesh_file(STEP, "ball").vertices - [0.03, 0.03, 0.04], axis=1)
    np.testing.assert_allclose(radius, 0.008, rtol=1e-4)


def test_step_in_inches_is_converted() -> None:
    found = read_mesh_file(INCHES)
    assert box(found) == pytest.approx(np.array([[-0.0254, -0.0254, 0], [0.0254, 0.0254, 0.0508]]), rel=2e-3)
    assert volume(found) == pytest.approx(2 * np.pi * 0.0254**3, rel=5e-3)
    assert "the file states inch: coordinates were converted to meters" in found.notes


@pytest.mark.parametrize(
    ("node", "low", "high"),
    [("peg:2", [65, 40, 20], [75, 50, 70]), ("assembly/plate", [0, 0, 0], [100, 60, 20])],
)
def test_a_product_of_a_step_assembly_is_chosen_in_its_place(node: str, low: list[float], high: list[float]) -> None:
    np.testing.assert_allclose(box(read_mesh_file(STEP, node)), np.array([low, high]) / 1e3, atol=1e-4)


def test_the_importers_process_reads_step(tmp_path: Path) -> None:
    report = import_field(STEP, tmp_path / "out", {"node": "plate"})
    assert report.isolation["system_call_filter"] or not report.isolation["no_new_privileges"]
    assert report.why[0].startswith("a step file: ")
    assert "only the node assembly/plate" in report.why
    np.testing.assert_allclose(report.surface_bounds, [[0, 0, 0], [0.1, 0.06, 0.02]], atol=1e-3)
    damaged = tmp_path / "damaged.stp"
    damaged.write_bytes(STEP.read_bytes().replace(b"ADVANCED_FACE", b"NO_FACE_AT_ALL"))
    assert_refused(lambda: import_field(damaged, tmp_path / "out"), "MESH_INVALID")


def test_damaged_step_files_are_refused() -> None:
    data = STEP.read_bytes()
    for broken in (data[: len(data) // 2], data[:14], b"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\n"):
        assert sniff_format(broken[:HEAD_BYTES]) == "step"
        assert_refused(lambda given=broken: read_mesh("step", memoryview(given)), "MESH_INVALID")


def test_without_its_library_step_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cascadio", None)
    with pytest.raises(FieldFormatError) as caught:
        read_mesh_file(STEP)
    assert caught.value.reason == "FORMAT_NOT_SUPPORTED"
    assert "pip install 'regnf[cad]'" in str(caught.value.hint)
    assert ".glb" in str(caught.value.hint)


def test_a_step_file_is_fitted_like_any_mesh() -> None:
    field, _ = load_solid(INCHES)
    center = field.bounds.mean(dim=0)
    assert float(field.signed_distance(center[None])) == pytest.approx(-0.0254, rel=1e-2)


# 3MF


def package(model: str, *others: tuple[str, str], unit: str = "meter") -> bytes:
    head = f'<model unit="{unit}" xmlns="{CORE}/core/2015/02" xmlns:p="{CORE}/production/2015/06">'
    parts = [
        ("3D/3dmodel.model", f"{head}{model}</model>"),
        *((name, f"{head}{text}</model>") for name, text in others),
    ]
    entries = [("[Content_Types].xml", b"<Types/>"), *((name, text.encode()) for name, text in parts)]
    return zip_bytes(entries, zipfile.ZIP_DEFLATED)


def read_3mf(data: bytes, node: str | None = None) -> Geometry:
    assert sniff_format(data[:HEAD_BYTES]) == "3mf"
    return read_mesh("3mf", memoryview(data), node=node)


def test_a_3mf_of_another_program_is_read_with_its_components_and_unit() -> None:
    found = read_mesh_file(PAIR)
    assert box(found) == [[-0.01, -0.02, 0], [0.12, 0.02, 0.06]]  # the second lies along x, around 10 cm
    assert volume(found) == pytest.approx(2 * 48e-6)
    assert found.notes == ("the file states centimeter: coordinates were converted to meters",)
    assert box(read_mesh_file(PAIR, "block")) == [[-0.01, -0.02, 0], [0.01, 0.02, 0.06]]
    with pytest.raises(FieldFormatError, match="the file has block, pair"):
        read_mesh_file(PAIR, "brick")


def test_the_importers_process_reads_3mf(tmp_path: Path) -> None:
    report = import_field(PAIR, tmp_path / "out")
    np.testing.assert_allclose(report.surface_bounds, [[-0.01, -0.02, 0], [0.12, 0.02, 0.06]], atol=1e-3)


def test_components_in_other_parts_are_read_and_supports_are_not() -> None:
    part = ("3D/Objects/one.model", f'<resources><object id="7" name="inner">{TETRAHEDRON}</object></resources>')
    model = (
        '<resources><object id="1"><components><component p:path="/3D/Objects/one.model" objectid="7" '
        'transform="2 0 0 0 2 0 0 0 2 5 0 0"/></components></object>'
        f'<object id="2" type="support">{TETRAHEDRON}</object></resources>'
        '<build><item objectid="1" transform="1 0 0 0 1 0 0 0 1 0 0 9"/><item objectid="2"/></build>'
    )
    found = read_3mf(package(model, part))
    assert box(found) == [[5, 0, 9], [7, 2, 11]]
    assert found.notes == ("the file states meter",)
    assert volume(read_3mf(package(model, part, unit="inch"))) == pytest.approx(8 / 6 * 0.0254**3)


def ten_of_the_next(number: int) -> str:
    component = f'<component objectid="{number + 1}"/>'
    return f'<object id="{number}"><components>{10 * component}</components></object>'


@pytest.mark.parametrize(
    ("reason", "data"),
    [
        ("MESH_INVALID", package('<resources/><build><item objectid="3"/></build>')),
        ("MESH_INVALID", package("<resources>")),
        ("MESH_INVALID", package("<resources/><build/>", unit="cubit")),
        ("MESH_INVALID", package('<resources><object id="1"><mesh><vertices><vertex x="0" y="0"/>')),
        ("MESH_INVALID", package('<resources/><build><item objectid="1" transform="1 2 3"/></build>')),
        ("FORMAT_NOT_SUPPORTED", zip_bytes([("[Content_Types].xml", b"<Types/>"), ("word/document.xml", b"<w/>")])),
        (
            "MESH_INVALID",  # an object in itself
            package(
                '<resources><object id="1"><components><component objectid="1"/></components></object></resources>'
                '<build><item objectid="1"/></build>'
            ),
        ),
        (
            "MESH_INVALID",  # ten objects in ten objects in ten ...
            package(
                f'<resources>{"".join(map(ten_of_the_next, range(20)))}<object id="20">{TETRAHEDRON}</object>'
                '</resources><build><item objectid="0"/></build>'
            ),
        ),
        (
            "MESH_INVALID",
            zip_bytes(
                [
                    ("[Content_Types].xml", b"<Types/>"),
                    ("3D/3dmodel.model", b'<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><model>&b;</model>'),
                ]
            ),
        ),
    ],
)
def test_bad_packages_are_refused(reason: str, data: bytes) -> None:
    assert_refused(lambda: read_3mf(data), reason)
