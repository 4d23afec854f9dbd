"""USD scenes that Pixar's own library wrote: shapes, instances, units, and references that are not followed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.mesh_file import read_mesh_file
from regnf_core.importing.meshes import read_mesh
from regnf_core.importing.meshes.triangle_files import Geometry
from regnf_core.schema.safe_format import read_description
from tests.core.importing.archives import assert_refused, zip_bytes

BOX = trimesh.creation.box((2.0, 4.0, 6.0))


def stage_of(build: Callable[[Any], None], file: Path) -> Path:
    """A file that the library writes of what ``build`` makes of an empty stage."""
    stage = Usd.Stage.CreateNew(str(file))
    build(stage)
    stage.GetRootLayer().Save()
    return file


def add_box(stage: Any, path: str) -> Any:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(BOX.vertices.astype("f4")))
    mesh.CreateFaceVertexCountsAttr([3] * len(BOX.faces))
    mesh.CreateFaceVertexIndicesAttr(BOX.faces.ravel().tolist())
    mesh.CreateSubdivisionSchemeAttr("none")
    return mesh


def room(stage: Any) -> None:
    """A box of 2 x 4 x 6 cm, turned to lie along y and moved, and a ball above it, in a world with z up."""
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.Xform.Define(stage, "/World").AddTranslateOp().Set((0, 0, 100))
    box = add_box(stage, "/World/Box")
    box.AddTranslateOp().Set((10, 0, 0))
    box.AddRotateXOp().Set(90)
    ball = UsdGeom.Sphere.Define(stage, "/World/Ball")
    ball.CreateRadiusAttr(3)
    ball.AddTranslateOp().Set((0, 0, 20))


def box_of(found: Geometry) -> list[list[float]]:
    corners = found.vertices[found.faces].reshape(-1, 3)
    return [corners.min(axis=0).round(6).tolist(), corners.max(axis=0).round(6).tolist()]


def volume(found: Geometry) -> float:
    return float(trimesh.Trimesh(found.vertices, found.faces, process=False).volume)


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_shapes_are_read_at_their_poses_in_meters(tmp_path: Path, ending: str) -> None:
    file = stage_of(room, tmp_path / f"room.{ending.replace('z', 'c')}")
    if ending == "usdz":
        assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(file)), str(tmp_path / "room.usdz"))
        file = tmp_path / "room.usdz"
    assert sniff_format(file.read_bytes()[:HEAD_BYTES]) == "usd"
    assert box_of(read_mesh_file(file, "/World/Box")) == [[0.09, -0.03, 0.98], [0.11, 0.03, 1.02]]
    assert box_of(read_mesh_file(file, "Ball")) == [[-0.03, -0.03, 1.17], [0.03, 0.03, 1.23]]
    found = read_mesh_file(file)
    assert found.up_axis == "z"
    assert found.notes == (
        "its nodes, to choose one by the import option node: Ball, Box",
        "the file states centimeter: coordinates were converted to meters",
    )
    with pytest.raises(FieldFormatError, match="the file has Ball, Box, World"):
        read_mesh_file(file, "Table")


@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_the_importers_process_reads_usd(tmp_path: Path, ending: str) -> None:
    report = import_field(stage_of(room, tmp_path / f"room.{ending}"), tmp_path / "out", {"node": "Box"})
    assert report.why[0].startswith("a usd file: 12 triangles")
    np.testing.assert_allclose(report.surface_bounds, [[0.09, -0.03, 0.98], [0.11, 0.03, 1.02]], atol=1e-3)
    assert read_description(tmp_path / "out" / "field.safetensors")["up_axis"] == "z"


def test_basic_shapes_have_their_size_and_axis(tmp_path: Path) -> None:
    def build(stage: Any) -> None:
        UsdGeom.Cube.Define(stage, "/cube").CreateSizeAttr(3)
        for kind, axis in (("Cylinder", "X"), ("Cone", "Y"), ("Capsule", "Z")):
            shape = getattr(UsdGeom, kind).Define(stage, f"/{kind}")
            shape.CreateRadiusAttr(1)
            shape.CreateHeightAttr(4)
            shape.CreateAxisAttr(axis)

    file = stage_of(build, tmp_path / "shapes.usda")
    expected = {
        "cube": ([[-1.5] * 3, [1.5] * 3], 27.0),
        "Cylinder": ([[-2, -1, -1], [2, 1, 1]], 4 * np.pi),
        "Cone": ([[-1, -2, -1], [1, 2, 1]], 4 / 3 * np.pi),
        "Capsule": ([[-1, -1, -3], [1, 1, 3]], (4 + 4 / 3) * np.pi),
    }
    for name, (extent, size) in expected.items():
        found = read_mesh_file(file, name)
        np.testing.assert_allclose(box_of(found), extent, atol=2e-3)
        assert volume(found) == pytest.approx(size, rel=0.01)
    assert read_mesh_file(file).notes[-1] == "the file states no unit"
    assert read_mesh_file(file).up_axis is None


def test_polygons_holes_and_left_handed_faces(tmp_path: Path) -> None:
    def build(stage: Any) -> None:
        mesh = UsdGeom.Mesh.Define(stage, "/cube")
        mesh.CreatePointsAttr([Gf.Vec3f(*corner) for corner in np.ndindex(2, 2, 2)])
        sides = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
        mesh.CreateFaceVertexCountsAttr([4] * 6 + [3])
        mesh.CreateFaceVertexIndicesAttr([*sides, 0, 1, 7])
        mesh.CreateHoleIndicesAttr([6])
        mesh.CreateOrientationAttr("leftHanded")
        mesh.CreateSubdivisionSchemeAttr("catmullClark")

    found = read_mesh_file(stage_of(build, tmp_path / "cube.usda"))
    assert len(found.faces) == 12
    assert volume(found) == pytest.approx(-1.0)  # right-handed they look outward
    assert found.not_applied == ("the smooth surfaces of subdivision (their control meshes are read)",)


def test_instances_of_both_kinds_are_read(tmp_path: Path) -> None:
    def build(stage: Any) -> None:
        UsdGeom.Xform.Define(stage, "/Prototype")
        add_box(stage, "/Prototype/Box")
        for number in range(3):
            copy = UsdGeom.Xform.Define(stage, f"/Copy{number}")
            copy.AddTranslateOp().Set((0, 0, 100 * (number + 1)))
            copy.GetPrim().GetReferences().AddInternalReference("/Prototype")
            copy.GetPrim().SetInstanceable(True)
        many = UsdGeom.PointInstancer.Define(stage, "/Many")
        ball = UsdGeom.Sphere.Define(stage, "/Many/Ball")
        ball.AddScaleOp().Set((2, 2, 2))
        many.CreatePrototypesRel().AddTarget(ball.GetPath())
        many.CreateProtoIndicesAttr([0, 0, 0])
        many.CreatePositionsAttr([(50, 0, 0), (60, 0, 0), (70, 0, 0)])
        many.CreateInvisibleIdsAttr([1])

    found = read_mesh_file(stage_of(build, tmp_path / "copies.usdc"))
    assert volume(found) == pytest.approx(4 * 48 + 2 * 8 * 4 / 3 * np.pi, rel=0.01)
    assert found.not_applied == ()
    assert box_of(found) == [[-1, -2, -3], [72, 2, 303]]
    balls = read_mesh_file(tmp_path / "copies.usdc", "Many")
    assert box_of(balls) == [[48, -2, -2], [72, 2, 2]]
    assert not ((balls.vertices[:, 0] > 53) & (balls.vertices[:, 0] < 67)).any()


def test_what_is_not_drawn_is_not_read(tmp_path: Path) -> None:
    def build(stage: Any) -> None:
        add_box(stage, "/Box")
        add_box(stage, "/Hidden/Box").AddTranslateOp().Set((99, 0, 0))
        UsdGeom.Imageable(UsdGeom.Xform.Define(stage, "/Hidden")).MakeInvisible()
        UsdGeom.Sphere.Define(stage, "/Guide").CreatePurposeAttr("guide")
        UsdGeom.Sphere.Define(stage, "/Off").GetPrim().SetActive(False)
        UsdGeom.NurbsPatch.Define(stage, "/Patch")

    found = read_mesh_file(stage_of(build, tmp_path / "some.usda"))
    assert box_of(found) == [[-1, -2, -3], [1, 2, 3]]
    assert found.not_applied == ("NurbsPatch prims",)


def test_layers_that_came_with_it_are_read_and_others_never(tmp_path: Path) -> None:
    stage_of(lambda stage: stage.SetDefaultPrim(add_box(stage, "/Box").GetPrim()), tmp_path / "box.usdc")
    secret = tmp_path / "elsewhere" / "secret.usda"
    secret.parent.mkdir()
    stage_of(lambda stage: stage.SetDefaultPrim(UsdGeom.Sphere.Define(stage, "/S").GetPrim()), secret)

    def build(stage: Any) -> None:
        stage.DefinePrim("/Near").GetReferences().AddReference("./box.usdc")
        stage.DefinePrim("/Far").GetReferences().AddReference(str(secret))
        stage.DefinePrim("/Payload").GetPayloads().AddPayload("./elsewhere/secret.usda")
        clips = Usd.ClipsAPI(UsdGeom.Xform.Define(stage, "/Clips"))
        clips.SetClipAssetPaths([Sdf.AssetPath(str(secret))])
        clips.SetClipPrimPath("/S")

    file = stage_of(build, tmp_path / "main.usda")
    found = read_mesh_file(file)
    assert len(found.faces) == 12
    assert found.not_applied == ("references to files that did not come with it",)
    alone = memoryview(file.read_bytes())
    assert len(read_mesh("usd", alone).faces) == 0
    layers = {"main.usda": bytes(alone), "box.usdc": (tmp_path / "box.usdc").read_bytes()}
    assert len(read_mesh("usd", memoryview(zip_bytes(list(layers.items())))).faces) == 12
    assert len(read_mesh("usd", alone, {"box.usdc": memoryview(layers["box.usdc"])}).faces) == 12


def test_layers_that_refer_to_each_other_end(tmp_path: Path) -> None:
    for name, other in (("a", "b"), ("b", "a")):
        file = tmp_path / f"{name}.usda"
        file.write_text(f'#usda 1.0\n( subLayers = [@./{other}.usda@] )\ndef Sphere "{name}" {{}}\n')
    assert sorted(set(read_mesh_file(tmp_path / "a.usda").notes[0].rpartition(": ")[2].split(", "))) == ["a", "b"]


@pytest.mark.parametrize(
    "text",
    [
        'def Sphere "s" { double radius = -1 }',
        'def Mesh "m" { point3f[] points = [(0,0,0)] int[] faceVertexCounts = [3] int[] faceVertexIndices = [0,1,2] }',
        'def Mesh "m" { point3f[] points = [(0,0,0)] int[] faceVertexCounts = [9] int[] faceVertexIndices = [0,0,0] }',
        'def PointInstancer "p" { int[] protoIndices = [0, 0] point3f[] positions = [(0,0,0)] }',
        'def Sphere "s" { this is no usda',
    ],
)
def test_faulty_scenes_are_refused(text: str) -> None:
    assert_refused(lambda: read_mesh("usd", memoryview(f"#usda 1.0\n{text}\n".encode())), "MESH_INVALID")


def test_damaged_binary_files_are_refused(tmp_path: Path) -> None:
    data = stage_of(room, tmp_path / "room.usdc").read_bytes()
    for broken in (data[:100], data[: len(data) // 2], data[:8] + bytes(200)):
        assert_refused(lambda given=broken: read_mesh("usd", memoryview(given)), "MESH_INVALID")


def test_without_its_library_usd_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(FieldFormatError) as caught:
        read_mesh("usd", memoryview(b"#usda 1.0\n"))
    assert caught.value.reason == "FORMAT_NOT_SUPPORTED"
    assert "pip install 'regnf[cad]'" in str(caught.value.hint)
