"""Write the files of tests/core/importing/meshes/data, by other programs than regnf:

    pip install cadquery-ocp lib3mf meshoptimizer numpy   # in an environment of its own
    python scripts/make_cad_files.py

assembly.step: OpenCASCADE; a plate with a hole (100 x 60 x 20 mm), two pegs and a ball. inches.step: a cylinder of
radius 1 and height 2 inches. pair.3mf: lib3mf; a block of 2 x 4 x 6 cm, twice, one of them turned. meshopt.json:
meshoptimizer's own encoders, and what its decoders give.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "core" / "importing" / "meshes" / "data"
SEED = 0


def write_step(path: Path, parts: list[tuple[str, Any, list[tuple[float, float, float]]]], unit: str) -> None:
    """One assembly. parts: name, shape, and where it is, once or several times."""
    from OCP.gp import gp_Trsf, gp_Vec
    from OCP.Interface import Interface_Static
    from OCP.STEPCAFControl import STEPCAFControl_Writer
    from OCP.STEPControl import STEPControl_AsIs
    from OCP.TCollection import TCollection_ExtendedString as Text
    from OCP.TDataStd import TDataStd_Name
    from OCP.TDocStd import TDocStd_Document
    from OCP.TopLoc import TopLoc_Location
    from OCP.XCAFApp import XCAFApp_Application
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    document = TDocStd_Document(Text("assembly"))
    XCAFApp_Application.GetApplication_s().NewDocument(Text("MDTV-XCAF"), document)
    tool = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    assembly = tool.NewShape()
    TDataStd_Name.Set_s(assembly, Text("assembly"))
    for name, shape, places in parts:
        label = tool.AddShape(shape, False)
        TDataStd_Name.Set_s(label, Text(name))
        for number, place in enumerate(places, 1):
            moved = gp_Trsf()
            moved.SetTranslation(gp_Vec(*place))
            component = tool.AddComponent(assembly, label, TopLoc_Location(moved))
            TDataStd_Name.Set_s(component, Text(name if len(places) == 1 else f"{name}:{number}"))
    tool.UpdateAssemblies()
    writer = STEPCAFControl_Writer()
    Interface_Static.SetCVal_s("write.step.unit", unit)
    writer.SetNameMode(True)
    writer.Transfer(document, STEPControl_AsIs)
    writer.Write(str(path))


def write_models() -> None:
    """The two STEP files."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakeSphere
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    box = BRepPrimAPI_MakeBox(gp_Pnt(0, 0, 0), 100, 60, 20).Shape()
    hole = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(30, 30, -1), gp_Dir(0, 0, 1)), 10, 40).Shape()
    plate = BRepAlgoAPI_Cut(box, hole).Shape()
    peg, ball = BRepPrimAPI_MakeCylinder(5, 50).Shape(), BRepPrimAPI_MakeSphere(8).Shape()
    places = [("plate", plate, [(0, 0, 0)]), ("peg", peg, [(70, 15, 20), (70, 45, 20)]), ("ball", ball, [(30, 30, 40)])]
    write_step(FOLDER / "assembly.step", places, "MM")
    inch = 25.4
    cylinder = BRepPrimAPI_MakeCylinder(1 * inch, 2 * inch).Shape()
    write_step(FOLDER / "inches.step", [("cylinder", cylinder, [(0, 0, 0)])], "INCH")


def write_pair() -> None:
    """The 3MF file."""
    import lib3mf

    model = lib3mf.get_wrapper().CreateModel()
    model.SetUnit(lib3mf.ModelUnit.CentiMeter)
    block, pair = model.AddMeshObject(), model.AddComponentsObject()
    block.SetName("block")
    pair.SetName("pair")
    for x in (-1, 1):
        for y in (-2, 2):
            for z in (-3, 3):
                corner = lib3mf.Position()
                corner.Coordinates[:] = [x, y, z]
                block.AddVertex(corner)
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    for a, b, c, d in sides:
        for corners in ((a, b, c), (a, c, d)):
            triangle = lib3mf.Triangle()
            triangle.Indices[:] = corners
            block.AddTriangle(triangle)

    def placed(shift: tuple[float, float, float], turned: bool = False) -> Any:
        """turned: by 90 degrees about z."""
        transform = lib3mf.Transform()
        rows = ((0, 1, 0), (-1, 0, 0), (0, 0, 1)) if turned else ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        for number, row in enumerate((*rows, shift)):
            for column, value in enumerate(row):
                transform.Fields[number][column] = value
        return transform

    pair.AddComponent(block, placed((0, 0, 0)))
    pair.AddComponent(block, placed((10, 0, 0), turned=True))
    model.AddBuildItem(pair, placed((0, 0, 3)))
    model.QueryWriter("3mf").WriteToFile(str(FOLDER / "pair.3mf"))


def write_meshopt() -> None:
    """Cases as [mode, filter, count, stride, encoded, decoded]."""
    import meshoptimizer as library

    random = np.random.default_rng(SEED)
    cases: list[list[Any]] = []

    def case(mode: str, filter_: str, count: int, stride: int, encoded: Any, decoded: Any) -> None:
        texts = [base64.b64encode(bytes(data)).decode() for data in (encoded, np.ascontiguousarray(decoded))]
        cases.append([mode, filter_, count, stride, *texts])

    library.encode_index_version(1)
    library.encode_vertex_version(0)
    for count, stride in ((1, 4), (17, 8), (300, 12), (40, 256)):
        items = random.integers(0, 256, (count, stride)).astype(np.uint8)
        items[:, ::2] //= 50
        items[:, 1::4] = 0
        case("ATTRIBUTES", "NONE", count, stride, library.encode_vertex_buffer(items, count, stride), items)
    wave = np.rint(1000 * np.sin(np.arange(900) / 50)).astype("<i4").reshape(300, 3)
    case("ATTRIBUTES", "NONE", 300, 12, library.encode_vertex_buffer(wave.view(np.uint8), 300, 12), wave)
    start = np.add.outer(13 * np.arange(12), np.arange(12)).ravel()
    grid = np.concatenate([np.stack([start, start + 1, start + 14], 1), np.stack([start, start + 14, start + 13], 1)])
    cached = np.zeros(grid.size, np.uint32)
    library.optimize_vertex_cache(cached, grid.astype(np.uint32).ravel(), grid.size, 169)
    for order in (grid.ravel(), cached, random.integers(0, 60_000, 300)):
        order = order.astype("<u4")
        packed = library.encode_index_buffer(order, len(order), int(order.max()) + 1)
        case("TRIANGLES", "NONE", len(order), 4, packed, library.decode_index_buffer(len(order), 4, packed))
        packed = library.encode_index_sequence(order, len(order), int(order.max()) + 1)
        case("INDICES", "NONE", len(order), 4, packed, order)
    unit = random.normal(size=(100, 3))
    x, y, z = (unit / np.abs(unit).sum(1, keepdims=True)).T
    folded = (np.where(z >= 0, x, (1 - abs(y)) * np.sign(x)), np.where(z >= 0, y, (1 - abs(x)) * np.sign(y)))
    for kind, name, stride in (("i1", "OCTAHEDRAL", 4), ("<i2", "OCTAHEDRAL", 8)):
        top = np.iinfo(kind).max
        items = np.stack([np.rint(top * folded[0]), np.rint(top * folded[1]), 0 * x + top, 0 * x + 5], 1).astype(kind)
        packed = library.encode_vertex_buffer(items.view(np.uint8).reshape(100, stride), 100, stride)
        case("ATTRIBUTES", name, 100, stride, packed, library.decode_filter_oct(items.copy(), 100, stride))
    turns = random.normal(size=(100, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    items = np.zeros((100, 4), "<i2")
    for turn, item in zip(turns, items, strict=True):
        largest = int(np.abs(turn).argmax())
        item[:3] = np.rint(np.sign(turn[largest]) * turn[(largest + np.arange(1, 4)) % 4] * np.sqrt(2) * 2047)
        item[3] = 2044 | largest
    packed = library.encode_vertex_buffer(items.view(np.uint8).reshape(100, 8), 100, 8)
    case("ATTRIBUTES", "QUATERNION", 100, 8, packed, library.decode_filter_quat(items.copy(), 100, 8))
    powers, numbers = random.integers(-20, 5, (100, 3)), random.integers(-(2**22), 2**22, (100, 3))
    items = ((powers << 24) | (numbers & 0xFFFFFF)).astype("<i4")
    packed = library.encode_vertex_buffer(items.view(np.uint8).reshape(100, 12), 100, 12)
    case("ATTRIBUTES", "EXPONENTIAL", 100, 12, packed, np.ldexp(numbers.astype("f4"), powers).astype("<f4"))
    (FOLDER / "meshopt.json").write_text(json.dumps(cases, indent=0) + "\n")


if __name__ == "__main__":
    write_models()
    write_pair()
    write_meshopt()
