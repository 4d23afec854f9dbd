"""The solid of ``benchmarks.foreign_files``, and who writes it: each function, with one library, in its formats."""

from __future__ import annotations

import contextlib
import itertools
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

EDGES = (np.array([0.0, 0.3, 0.5, 1.0]), np.array([0.0, 0.25, 0.7]), np.array([0.0, 0.2, 0.45, 0.6]))
FULL = ((0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (2, 0, 1), (2, 0, 2), (0, 0, 1))
"""Boxes between the edges that are matter: the solid has no symmetry."""


def solid() -> trimesh.Trimesh:
    """Its faces outward, one unit a meter, z up."""
    quads = []
    for cell, axis, side in itertools.product(FULL, range(3), (0, 1)):
        if tuple(np.add(cell, np.eye(3, dtype=int)[axis] * (2 * side - 1))) not in FULL:
            corners = np.tile(cell, (4, 1))
            corners[:, axis] += side
            corners[:, [(axis + 1) % 3, (axis + 2) % 3]] += [(0, 0), (1, 0), (1, 1), (0, 1)]
            quads.append(corners if side else corners[::-1])
    places = np.stack([edge[np.concatenate(quads)[:, axis]] for axis, edge in enumerate(EDGES)], axis=1)
    first = 4 * np.arange(len(quads))[:, None]
    mesh = trimesh.Trimesh(places, np.concatenate([first + np.array([[0, 1, 2]]), first + np.array([[0, 2, 3]])]))
    mesh.merge_vertices()
    return mesh


@dataclass(frozen=True)
class File:
    """scale: from the solid to the field's unit."""

    path: Path
    scale: float = 1.0
    is_cloud: bool = False


S = solid()
V, F = np.asarray(S.vertices), np.asarray(S.faces)
POINTS, _index = (np.asarray(each) for each in trimesh.sample.sample_surface(S, 8_000, seed=0))
NORMALS = np.asarray(S.face_normals)[_index]


def of_trimesh(folder: Path) -> Iterator[File]:
    for name in ("binary.ply", "binary.stl", "mesh.obj", "mesh.off", "mesh.glb", "mesh.3mf"):
        S.export(folder / name)
        yield File(folder / name, 1e-3 if name.endswith("3mf") else 1.0)
    S.export(folder / "text.ply", encoding="ascii")
    S.export(folder / "text.stl", file_type="stl_ascii")
    with zipfile.ZipFile(folder / "gltf.zip", "w") as archive:
        for name, data in S.export(file_type="gltf").items():
            archive.writestr(name, data)
    yield from (File(folder / name) for name in ("text.ply", "text.stl", "gltf.zip"))
    trimesh.PointCloud(POINTS).export(folder / "cloud.ply")
    yield File(folder / "cloud.ply", is_cloud=True)


def of_open3d(folder: Path) -> Iterator[File]:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(V), o3d.utility.Vector3iVector(F))
    mesh.compute_triangle_normals()
    for name in ("binary.ply", "text.ply", "a.stl", "a.obj", "a.off", "a.glb", "a.gltf"):
        o3d.io.write_triangle_mesh(str(folder / name), mesh, write_ascii=name == "text.ply")
        yield File(folder / name)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.normals, cloud.colors = o3d.utility.Vector3dVector(NORMALS), o3d.utility.Vector3dVector(0.0 * POINTS)
    for name in ("text.pcd", "binary.pcd", "packed.pcd", "a.xyz", "a.xyzn", "a.xyzrgb", "a.pts", "cloud.ply"):
        how = {"write_ascii": name == "text.pcd", "compressed": name == "packed.pcd"}
        o3d.io.write_point_cloud(str(folder / name), cloud, **how)
        yield File(folder / name, is_cloud=True)


def of_laspy(folder: Path) -> Iterator[File]:
    import laspy

    for name, version, form in (("a.las", "1.2", 0), ("b.las", "1.4", 6), ("a.laz", "1.2", 3), ("b.laz", "1.4", 7)):
        header = laspy.LasHeader(version=version, point_format=form)
        header.scales, header.offsets = np.full(3, 1e-5), V.min(0)
        las = laspy.LasData(header)
        las.x, las.y, las.z = POINTS.T
        las.write(str(folder / name))
        yield File(folder / name, is_cloud=True)


def of_pye57(folder: Path) -> Iterator[File]:
    import pye57

    # The quaternion's turn takes x to y, y to z and z to x.
    for name, turn, columns in (("a.e57", (1.0, 0, 0, 0), POINTS), ("b.e57", (0.5,) * 4, POINTS[:, [1, 2, 0]])):
        with contextlib.closing(pye57.E57(str(folder / name), "w")) as file:
            data = {f"cartesian{axis}": column.copy() for axis, column in zip("XYZ", columns.T, strict=True)}
            file.write_scan_raw(data, rotation=np.array(turn), translation=np.zeros(3))
        yield File(folder / name, is_cloud=True)


def of_plyfile(folder: Path) -> Iterator[File]:
    import plyfile

    for name, text, order, kind in (("t", True, "=", "f4"), ("l", False, "<", "f8"), ("b", False, ">", "f4")):
        vertices = np.array([tuple(v) for v in V], [(axis, kind) for axis in "xyz"])
        faces = np.array([(f,) for f in F], [("vertex_indices", "i4", (3,))])
        elements = [plyfile.PlyElement.describe(vertices, "vertex"), plyfile.PlyElement.describe(faces, "face")]
        plyfile.PlyData(elements, text=text, byte_order=order).write(folder / f"{name}.ply")
        yield File(folder / f"{name}.ply")


def of_meshio(folder: Path) -> Iterator[File]:
    import meshio

    for name in ("b.ply", "t.ply", "b.stl", "t.stl", "a.obj", "a.off", "a.vtk", "a.vtu", "a.msh", "a.mesh", "a.inp"):
        how = {"binary": name[0] == "b"} if name.endswith(("ply", "stl")) else {}
        meshio.write(folder / name, meshio.Mesh(V, [("triangle", F)]), **how)
        yield File(folder / name)


def of_numpy_stl(folder: Path) -> Iterator[File]:
    import stl

    mesh = stl.mesh.Mesh(np.zeros(len(F), dtype=stl.mesh.Mesh.dtype))
    mesh.vectors[:] = V[F]
    for mode in (stl.Mode.BINARY, stl.Mode.ASCII):
        mesh.save(str(folder / f"{mode.name}.stl"), mode=mode)
        yield File(folder / f"{mode.name}.stl")


def of_pygltflib(folder: Path) -> Iterator[File]:
    import pygltflib as gl

    places = (1000.0 * V[F]).astype("<f4").reshape(-1, 3)
    low, high, data = places.min(0).tolist(), places.max(0).tolist(), places.tobytes()
    document = gl.GLTF2(scene=0, scenes=[gl.Scene(nodes=[0])], buffers=[gl.Buffer(byteLength=len(data))])
    document.nodes = [gl.Node(children=[1], scale=[1e-3] * 3), gl.Node(mesh=0)]
    document.meshes = [gl.Mesh(primitives=[gl.Primitive(attributes=gl.Attributes(POSITION=0))])]
    document.accessors = [gl.Accessor(bufferView=0, componentType=gl.FLOAT, count=len(places), type=gl.VEC3)]
    document.accessors[0].min, document.accessors[0].max = low, high
    document.bufferViews = [gl.BufferView(buffer=0, byteLength=len(data))]
    document.set_binary_blob(data)
    document.save_binary(folder / "a.glb")
    document.convert_buffers(gl.BufferFormat.DATAURI)
    document.save_json(folder / "a.gltf")
    yield from (File(folder / "a.glb"), File(folder / "a.gltf"))


def of_usd(folder: Path) -> Iterator[File]:
    from pxr import Usd, UsdGeom, UsdUtils

    for name, unit in (("a.usda", 1.0), ("b.usdc", 0.01), ("c.usda", 0.001)):
        stage = Usd.Stage.CreateNew(str(folder / name))
        UsdGeom.SetStageMetersPerUnit(stage, unit)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        mesh = UsdGeom.Mesh.Define(stage, "/a/mesh")
        mesh.CreatePointsAttr((V / unit).tolist())
        mesh.CreateFaceVertexCountsAttr([3] * len(F))
        mesh.CreateFaceVertexIndicesAttr(F.ravel().tolist())
        stage.Save()
        yield File(folder / name)
    UsdUtils.CreateNewUsdzPackage(str(folder / "b.usdc"), str(folder / "b.usdz"))
    yield File(folder / "b.usdz")


def of_opencascade(folder: Path) -> Iterator[File]:
    from OCP import BRepAlgoAPI, BRepPrimAPI, BRepTools, IGESControl, STEPControl, gp

    shape = None
    for cell in FULL:
        ends = [gp.gp_Pnt(*(1e3 * edge[at + i] for edge, at in zip(EDGES, cell, strict=True))) for i in (0, 1)]
        box = BRepPrimAPI.BRepPrimAPI_MakeBox(*ends).Shape()
        shape = box if shape is None else BRepAlgoAPI.BRepAlgoAPI_Fuse(shape, box).Shape()
    step, iges = STEPControl.STEPControl_Writer(), IGESControl.IGESControl_Writer("MM", 1)
    step.Transfer(shape, STEPControl.STEPControl_StepModelType.STEPControl_AsIs)
    step.Write(str(folder / "a.step"))
    iges.AddShape(shape)
    iges.Write(str(folder / "a.igs"))
    BRepTools.BRepTools.Write_s(shape, str(folder / "a.brep"))
    yield from (File(folder / name) for name in ("a.step", "a.igs", "a.brep"))


def of_cascadio(folder: Path) -> Iterator[File]:
    import cascadio

    cascadio.step_to_glb(str(next(of_opencascade(folder)).path), str(folder / "a.glb"))
    yield File(folder / "a.glb")


def of_lib3mf(folder: Path) -> Iterator[File]:
    import lib3mf

    for name, meters in (("MilliMeter", 1e-3), ("Inch", 0.0254), ("Meter", 1.0)):
        model = lib3mf.get_wrapper().CreateModel()
        model.SetUnit(getattr(lib3mf.ModelUnit, name))
        mesh = model.AddMeshObject()
        for place in V:
            mesh.AddVertex(lib3mf.Position((lib3mf.ctypes.c_float * 3)(*place)))
        for face in F:
            mesh.AddTriangle(lib3mf.Triangle((lib3mf.ctypes.c_uint32 * 3)(*face.tolist())))
        model.AddBuildItem(mesh, lib3mf.get_wrapper().GetIdentityTransform())
        model.QueryWriter("3mf").WriteToFile(str(folder / f"{name}.3mf"))
        yield File(folder / f"{name}.3mf", meters)


def of_dracopy(folder: Path) -> Iterator[File]:
    import DracoPy

    (folder / "a.drc").write_bytes(DracoPy.encode(V, F, quantization_bits=16))
    yield File(folder / "a.drc")


def of_pyvista(folder: Path) -> Iterator[File]:
    import pyvista

    for name in ("b.ply", "t.ply", "b.stl", "t.stl", "a.obj", "a.vtp", "a.vtk"):
        pyvista.PolyData.from_regular_faces(V, F).save(folder / name, binary=name[0] != "t")
        yield File(folder / name)


def of_pymeshlab(folder: Path) -> Iterator[File]:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(V, F))
    for end in ("ply", "stl", "obj", "off", "3ds", "dae", "x3d", "wrl", "dxf", "ctm"):
        with contextlib.suppress(pymeshlab.PyMeshLabException):  # a build without this format
            meshes.save_current_mesh(str(folder / f"a.{end}"))
            yield File(folder / f"a.{end}")


WRITERS: dict[str, Callable[[Path], Iterator[File]]] = {
    "trimesh": of_trimesh, "open3d": of_open3d, "laspy": of_laspy, "pye57": of_pye57, "plyfile": of_plyfile,
    "meshio": of_meshio, "numpy-stl": of_numpy_stl, "pygltflib": of_pygltflib, "usd-core": of_usd,
    "cadquery-ocp": of_opencascade, "cascadio": of_cascadio, "lib3mf": of_lib3mf, "DracoPy": of_dracopy,
    "pyvista": of_pyvista, "pymeshlab": of_pymeshlab,
}  # fmt: skip
