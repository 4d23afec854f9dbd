"""A populated scene as a world of other programs: glTF, USD, MuJoCo, SDFormat, URDF. All are in meters.

Programs show the things' meshes. Things touch by boxes that fill them, because simulators take a mesh's convex hull,
which leaves no space below a table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.transformations import euler_from_matrix

from regnf_core.errors import atomic_path
from regnf_core.fields.composite import near_origin
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.population.bodies import Body, World, WorldThing
from regnf_core.population.collision import DENSITY, Boxes, Floats, Integers
from regnf_core.population.populate import Population
from regnf_core.surface.isosurface import extract_surface

GRAVITY = 9.81
"""m/s^2, along -z."""


def write_glb(world: World, path: Path) -> None:
    """One node for each thing, with its name and pose, below a node ``z_up`` that turns up to glTF's +y; meters."""
    scene: Any = trimesh.Scene(base_frame="base")
    turn = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    scene.graph.update(frame_from="base", frame_to="z_up", matrix=turn)
    for body in world.bodies:
        mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = body.R, body.t
        scene.add_geometry(mesh, body.name, body.name, parent_node_name="z_up", transform=pose)
    data: bytes = scene.export(file_type="glb")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _text(values: Any) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, np.float64).ravel().tolist())


def _quaternion(R: Floats) -> list[float]:
    """(w, x, y, z)."""
    quaternion: list[float] = np.roll(Rotation.from_matrix(R).as_quat(), 1).tolist()
    return quaternion


def write_usd(world: World, path: Path) -> None:
    """USD as text (.usda or .usd), z up: an Xform with a Mesh for each thing, bodies and colliders of UsdPhysics.

    Colliders of things and walls have the purpose "guide", which viewers do not show.
    """
    pull = ["vector3f physics:gravityDirection = (0, 0, -1)", f"float physics:gravityMagnitude = {GRAVITY}"]
    inner = _prim("PhysicsScene", "physics", pull)
    for name, boxes in world.static.items():
        inner += _prim("Xform", name, _usd_boxes(boxes, hidden=name.startswith("wall")))
    for body in world.bodies:
        content = [*_usd_pose(body.R, body.t), *_usd_mesh(body), *_usd_boxes(body.boxes, hidden=True)]
        moving = ("PhysicsRigidBodyAPI", "PhysicsMassAPI") if body.free else ()
        content = [*([f"float physics:density = {DENSITY:g}"] if body.free else ()), *content]
        inner += _prim("Xform", body.name, content, moving)
    lines = ["#usda 1.0", "(", '    defaultPrim = "main"', "    kilogramsPerUnit = 1", "    metersPerUnit = 1"]
    lines += ['    upAxis = "Z"', ")", "", *_prim("Xform", "main", inner), ""]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="ascii")


def _prim(kind: str, name: str, content: Iterable[str], applied: Sequence[str] = ()) -> list[str]:
    schemas = ", ".join(f'"{one}"' for one in applied)
    lines = [f'def {kind} "{name}"', *(["(", f"    prepend apiSchemas = [{schemas}]", ")"] if applied else ())]
    return [*lines, "{", *(f"    {line}" for line in content), "}"]


def _usd_tuple(values: Any) -> str:
    return f"({_text(values).replace(' ', ', ')})"


def _usd_pose(R: Floats, t: Any, size: Any = None) -> list[str]:
    lines = [f"double3 xformOp:translate = {_usd_tuple(t)}", f"quatd xformOp:orient = {_usd_tuple(_quaternion(R))}"]
    steps = ["translate", "orient"]
    if size is not None:
        lines.append(f"double3 xformOp:scale = {_usd_tuple(size)}")
        steps.append("scale")
    order = ", ".join(f'"xformOp:{step}"' for step in steps)
    return [*lines, f"uniform token[] xformOpOrder = [{order}]"]


def _usd_mesh(body: Body) -> list[str]:
    used = body.vertices[np.unique(body.faces)]
    return _prim(
        "Mesh",
        "visual",
        [
            f"float3[] extent = [{_usd_tuple(used.min(axis=0))}, {_usd_tuple(used.max(axis=0))}]",
            f"int[] faceVertexCounts = [{', '.join(['3'] * len(body.faces))}]",
            f"int[] faceVertexIndices = [{', '.join(map(str, body.faces.ravel().tolist()))}]",
            f"point3f[] points = [{', '.join(map(_usd_tuple, body.vertices))}]",
            'uniform token subdivisionScheme = "none"',
        ],
    )


def _usd_boxes(boxes: Boxes, hidden: bool) -> list[str]:
    content = ['uniform token purpose = "guide"'] if hidden else []
    for number, (center, size) in enumerate(zip(boxes.centers, boxes.sizes, strict=True)):
        cube = ["float3[] extent = [(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)]", "double size = 1"]
        content += _prim(
            "Cube", f"box_{number}", [*cube, *_usd_pose(boxes.axes, center, size)], ["PhysicsCollisionAPI"]
        )
    return _prim("Xform", "solid", content)


def _write_meshes(world: World, folder: Path) -> None:
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for body in world.bodies:
        lines = [f"v {_text(vertex)}" for vertex in body.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in (body.faces + 1).tolist()]
        with atomic_path(meshes / f"{body.name}.obj") as temporary:
            temporary.write_text("\n".join([*lines, ""]), encoding="ascii")


def _add(parent: Element, tag: str, text: str | None = None, **attributes: str) -> Element:
    made = SubElement(parent, tag, attributes)
    made.text = text
    return made


def _write_xml(root: Element, path: Path) -> None:
    indent(root)
    with atomic_path(path) as temporary:
        ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def write_mjcf(world: World, folder: Path) -> Path:
    """MuJoCo: ``scene.xml`` and ``meshes/*.obj``; the path of the former. Things that nothing carries have no joint."""
    _write_meshes(world, folder)
    root = Element("mujoco", model="world")
    _add(root, "compiler", meshdir="meshes", angle="radian")
    # Elliptic cones and a high ratio of friction's impedance: things at rest do not creep.
    _add(root, "option", gravity=f"0 0 {-GRAVITY}", integrator="implicitfast", cone="elliptic", impratio="10")
    standard = _add(root, "default")
    visual = _add(standard, "default", **{"class": "visual"})
    _add(visual, "geom", type="mesh", contype="0", conaffinity="0", group="2", mass="0")
    solid = _add(standard, "default", **{"class": "solid"})
    _add(solid, "geom", type="box", group="3", density=f"{DENSITY:g}")
    assets, place = _add(root, "asset"), _add(root, "worldbody")
    _add(place, "light", pos="0 0 5", dir="0 0 -1", directional="true")
    for name, boxes in world.static.items():
        _mjcf_boxes(_add(place, "body", name=name), boxes)
    for body in world.bodies:
        _add(assets, "mesh", name=body.name, file=f"{body.name}.obj", inertia="shell")
        made = _add(place, "body", name=body.name, pos=_text(body.t), quat=_text(_quaternion(body.R)))
        if body.free:
            _add(made, "freejoint", name=body.name)
        _add(made, "geom", mesh=body.name, **{"class": "visual"})
        _mjcf_boxes(made, body.boxes)
    _write_xml(root, folder / "scene.xml")
    return folder / "scene.xml"


def _mjcf_boxes(body: Element, boxes: Boxes) -> None:
    turn = _text(_quaternion(boxes.axes))
    for center, size in zip(boxes.centers, boxes.sizes, strict=True):
        _add(body, "geom", pos=_text(center), quat=turn, size=_text(size / 2.0), **{"class": "solid"})


def write_sdf(world: World, folder: Path) -> Path:
    """SDFormat 1.9, for Gazebo and PyBullet's loadSDF: ``world.sdf``, a model for each thing, and ``meshes/*.obj``."""
    _write_meshes(world, folder)
    root = Element("sdf", version="1.9")
    place = _add(root, "world", name="world")
    _add(place, "gravity", f"0 0 {-GRAVITY}")
    for name, boxes in world.static.items():
        _sdf_model(place, name, boxes, True)
    for body in world.bodies:
        link = _sdf_model(place, body.name, body.boxes, not body.free, body.R, body.t)
        visual = _add(link, "visual", name="visual")
        _add(_add(_add(visual, "geometry"), "mesh"), "uri", f"meshes/{body.name}.obj")
    _write_xml(root, folder / "world.sdf")
    return folder / "world.sdf"


def _sdf_model(
    place: Element, name: str, boxes: Boxes, static: bool, R: Floats | None = None, t: Floats | None = None
) -> Element:
    model = _add(place, "model", name=name)
    _add(model, "static", "1" if static else "0")  # PyBullet does not know "true"
    if R is not None:
        _add(model, "pose", _text([*(t if t is not None else ()), *_angles(R)]))
    link = _add(model, "link", name="link")
    mass, center, inertia = boxes.mass_properties()
    inertial = _add(link, "inertial")
    _add(inertial, "pose", _text([*center, 0.0, 0.0, 0.0]))
    _add(inertial, "mass", _text(mass))
    tensor = _add(inertial, "inertia")
    for key, value in _tensor(inertia):
        _add(tensor, key, value)
    for number, (middle, size) in enumerate(zip(boxes.centers, boxes.sizes, strict=True)):
        collision = _add(link, "collision", name=f"box_{number}")
        _add(collision, "pose", _text([*middle, *_angles(boxes.axes)]))
        _add(_add(_add(collision, "geometry"), "box"), "size", _text(size))
    return link


def _angles(R: Floats) -> Sequence[float]:
    """Roll, pitch, yaw about fixed axes."""
    angles_of: Callable[..., Sequence[float]] = euler_from_matrix
    return angles_of(R, "sxyz")


def _tensor(inertia: Floats) -> Iterator[tuple[str, str]]:
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        yield f"i{'xyz'[i]}{'xyz'[j]}", _text(inertia[i, j])


def write_urdf(world: World, folder: Path) -> Path:
    """``world.urdf`` and ``meshes/*.obj``: one link for each thing, all fixed to the link ``world``.

    So RViz, MoveIt and PyBullet's loadURDF take it as a world to plan in. URDF has no worlds of moving things: for
    those there is SDFormat.
    """
    _write_meshes(world, folder)
    root = Element("robot", name="world")
    _add(root, "link", name="world")
    for name, boxes in world.static.items():
        _urdf_link(root, name, boxes, np.eye(3), np.zeros(3))
    for body in world.bodies:
        visual = _add(_urdf_link(root, body.name, body.boxes, body.R, body.t), "visual")
        _add(_add(visual, "geometry"), "mesh", filename=f"meshes/{body.name}.obj")
    _write_xml(root, folder / "world.urdf")
    return folder / "world.urdf"


def _urdf_link(root: Element, name: str, boxes: Boxes, R: Floats, t: Floats) -> Element:
    link = _add(root, "link", name=name)
    mass, center, inertia = boxes.mass_properties()
    inertial = _add(link, "inertial")
    _add(inertial, "origin", xyz=_text(center), rpy="0 0 0")
    _add(inertial, "mass", value=_text(mass))
    _add(inertial, "inertia", **dict(_tensor(inertia)))
    for middle, size in zip(boxes.centers, boxes.sizes, strict=True):
        collision = _add(link, "collision")
        _add(collision, "origin", xyz=_text(middle), rpy=_text(_angles(boxes.axes)))
        _add(_add(collision, "geometry"), "box", size=_text(size))
    joint = _add(root, "joint", name=f"world_{name}", type="fixed")
    _add(joint, "parent", link="world")
    _add(joint, "child", link=name)
    _add(joint, "origin", xyz=_text(t), rpy=_text(_angles(R)))
    return link


# The worlds of a populated scene.

_RESOLUTION = 96
"""Cells along the longest edge of an object's bounds, of the surface that is drawn of a field without a mesh."""
FILES = {"glb": "scene.glb", "usd": "scene.usda", "mjcf": "mjcf", "sdf": "sdf", "urdf": "urdf"}
"""By the kind of world: the file, or the folder, in the folder that is given."""


def world_of(found: Population, meters: float = 1.0) -> World:
    """The placed objects with their own meshes, floor and walls, and what nothing explains. meters: in a scene unit."""
    surfaces = {number: _surface(found.library[number].field()) for number in {one.number for one in found.placements}}
    things = [WorldThing(one.name, one.T_scene_object, *surfaces[one.number]) for one in found.placements]
    up = found.up()
    surface = found.surface
    rest = surface.points[found.free]
    return World(
        things, np.array([0.0, 0.0, 1.0]) if up is None else up, surface.boundary, meters, rest, surface.spacing
    )


def _surface(field: SdfField) -> tuple[Floats, Integers]:
    """Vertices (V, 3) and faces (F, 3) of an object, its frame: its own, or drawn of the field."""
    if isinstance(field, MeshField):
        return field.vertices, field.faces
    near, origin = near_origin(field)
    drawn = extract_surface(near, _RESOLUTION)
    return drawn.vertices.astype(np.float64) + origin.numpy(), drawn.faces.astype(np.int64)


def write_worlds(found: Population, folder: Path, kinds: Sequence[str], meters: float = 1.0) -> None:
    """Write the worlds of the ``kinds`` of ``FILES``."""
    world = world_of(found, meters)
    writers: dict[str, Callable[[World, Path], object]] = {
        "glb": write_glb, "usd": write_usd, "mjcf": write_mjcf, "sdf": write_sdf, "urdf": write_urdf
    }  # fmt: skip
    for kind in kinds:
        writers[kind](world, folder / FILES[kind])
