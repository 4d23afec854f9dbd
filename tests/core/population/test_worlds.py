"""Worlds in other programs' formats: what stands stays, what hangs is static, meshes and poses are the given ones."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdPhysics, UsdValidation
from scipy.spatial.transform import Rotation

from regnf_core.geometry.sim3 import Sim3
from regnf_core.population.bodies import Body
from regnf_core.population.collision import (
    DENSITY,
    Boxes,
    apart,
    carried,
    mesh_boxes,
    point_boxes,
    slab,
    surface_points,
)
from regnf_core.population.proposals import BoundaryPlane
from regnf_core.population.worlds import World, WorldThing, write_glb, write_mjcf, write_sdf, write_urdf, write_usd

Floats = NDArray[np.float64]

METERS = 0.37
"""In a unit of the scene."""
T_SCENE_ROOM = Sim3.from_quaternion(1.0 / METERS, [0.3, -0.5, 0.2, 0.8], [4.0, -7.0, 2.0])
"""The room's frame has meters, z up and the floor at z = 0."""
MOVED_M = 0.02
NAMES = ("Tisch", "Stuhl 2/ä", "mug", "mug", 'Bild <1> & "2"', "MUG")


def block(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def legs(x: float, y: float, height: float, edge: float) -> list[trimesh.Trimesh]:
    half = edge / 2.0
    places = product((half - x / 2.0, x / 2.0 - half), (half - y / 2.0, y / 2.0 - half))
    return [block((a - half, b - half, 0.0), (a + half, b + half, height)) for a, b in places]


@cache
def table() -> trimesh.Trimesh:
    """1.4 x 0.8 m, its top from 0.70 to 0.73 m."""
    return trimesh.util.concatenate([*legs(1.4, 0.8, 0.7, 0.05), block((-0.7, -0.4, 0.7), (0.7, 0.4, 0.73))])


def chair() -> trimesh.Trimesh:
    seat, back = block((-0.2, -0.2, 0.42), (0.2, 0.2, 0.45)), block((-0.2, 0.17, 0.45), (0.2, 0.2, 0.68))
    return trimesh.util.concatenate([*legs(0.4, 0.4, 0.42, 0.03), seat, back])


def mug() -> trimesh.Trimesh:
    wall = trimesh.creation.revolve([(0, 0), (0.04, 0), (0.04, 0.1), (0.035, 0.1), (0.035, 0.006), (0, 0.006)])
    assert wall.is_watertight
    return wall


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> Sim3:
    return Sim3.from_quaternion(1.0, Rotation.from_euler("z", yaw).as_quat().tolist(), [x, y, z])


def thing(name: str, mesh: trimesh.Trimesh, T_room_object: Sim3, unit: float = 1.0) -> WorldThing:
    """unit: meters in a unit of the object's frame."""
    T = T_SCENE_ROOM @ T_room_object @ Sim3(torch.tensor(unit).double(), torch.eye(3).double(), torch.zeros(3).double())
    return WorldThing(name, T, np.asarray(mesh.vertices) / unit, np.asarray(mesh.faces, np.int64))


def plane(normal: tuple[float, ...], offset: float) -> BoundaryPlane:
    """Of the room, in the scene's frame."""
    turned = T_SCENE_ROOM.rotation.numpy() @ np.array(normal)
    place = T_SCENE_ROOM.apply(torch.tensor([normal]).double() * offset).numpy()[0]
    return BoundaryPlane(turned, float(turned @ place))


ROOM = (
    (table(), pose(0.3, 0.2, 0.0, 0.6), 0.01),
    (chair(), pose(0.3, 0.2, 0.0, 0.6 + np.pi), 1.0),
    (mug(), pose(0.1, 0.2, 0.7304, 1.0), 0.05),
    (mug(), pose(0.5, 0.4, 0.7304), 1.0),
    (block((-0.3, -0.01, -0.2), (0.3, 0.01, 0.2)), pose(0.0, 1.489, 1.5), 1.0),  # hangs on the wall
    (mug(), pose(1.2, -0.6, 0.0004), 1.0),
)


def up() -> Floats:
    found: Floats = T_SCENE_ROOM.rotation.numpy()[:, 2]
    return found


def room() -> World:
    things = [thing(name, *rest) for name, rest in zip(NAMES, ROOM, strict=True)]
    walls = [plane((0.0, -1.0, 0.0), -1.5), plane((0.0, 0.0, -1.0), -2.6)]
    return World(things, up(), [walls[0], plane((0.0, 0.0, 1.0), 0.0), walls[1]], METERS, np.zeros((0, 3)), 0.02)


def corners_of(world: World) -> dict[str, Floats]:
    """The vertices of each thing in the world, found by the transforms alone."""
    T = world.T_world_scene
    return {
        body.name: (T @ one.T_scene_object).apply(torch.from_numpy(one.vertices)).numpy()
        for body, one in zip(world.bodies, world.things, strict=True)
    }


def moved(file: Path, bodies: list[Body], seconds: float = 5.0) -> dict[str, float]:
    """By name: how far MuJoCo has each thing's center of mass move."""
    model = mujoco.MjModel.from_xml_path(str(file))
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    start = state.xipos.copy()
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, state)
    way = np.linalg.norm(state.xipos - start, axis=1)
    return {body.name: float(way[model.body(body.name).id]) for body in bodies}


# Collision boxes.


def test_boxes_fill_a_table_and_leave_the_space_below_it_free() -> None:
    turned = table().copy().apply_transform(trimesh.transformations.rotation_matrix(0.4, (0, 0, 1)))
    boxes, points = mesh_boxes(np.asarray(turned.vertices), np.asarray(turned.faces, np.int64))
    assert len(boxes) < 40
    top, four_legs = 1.4 * 0.8 * 0.03, 4 * 0.05**2 * 0.7
    assert np.prod(boxes.sizes, axis=1).sum() == pytest.approx(top + four_legs, rel=0.1)
    assert boxes.high[:, 2].max() == pytest.approx(0.73)
    assert boxes.low[:, 2].min() == pytest.approx(0.0)
    below = np.array([0.3, 0.1, 0.5]) @ boxes.axes
    assert not ((boxes.low < below) & (below < boxes.high)).all(axis=1).any()
    assert np.ptp(points, axis=0) == pytest.approx(np.ptp(turned.vertices, axis=0))


def test_feet_that_end_at_different_heights_end_at_one() -> None:
    uneven = trimesh.util.concatenate([block((0, 0, 0.01), (0.1, 0.1, 0.5)), block((0.4, 0, 0), (0.5, 0.1, 0.5))])
    boxes, _ = mesh_boxes(np.asarray(uneven.vertices), np.asarray(uneven.faces, np.int64))
    assert boxes.low[:, 2] == pytest.approx([0.0, 0.0])


def test_an_open_sheet_gives_boxes_with_some_thickness() -> None:
    sheet = np.array([[0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [1.0, 1.0, 0.5], [0.0, 1.0, 0.5]])
    boxes, _ = mesh_boxes(sheet, np.array([[0, 1, 2], [0, 2, 3]]))
    assert len(boxes) == 1
    assert boxes.sizes[0] == pytest.approx([1.0, 1.0, 1.0 / 28 / 4], abs=0.01)
    line, _ = mesh_boxes(np.array([[0.0, 0, 0], [0, 0, 1.0], [0, 0, 0.5]]), np.array([[0, 2, 1]]))
    assert line.sizes.min() > 0.0


def test_points_of_a_surface_are_no_farther_apart_than_the_step() -> None:
    sliver = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [5.0, 0.01, 0.0]])
    points = surface_points(sliver, np.array([[0, 1, 2]]), 0.1)
    assert np.diff(np.sort(points[:, 0])).max() <= 0.1
    assert len(points) < 2000


def test_mass_properties_are_those_of_mujoco(tmp_path: Path) -> None:
    world = room()
    model = mujoco.MjModel.from_xml_path(str(write_mjcf(world, tmp_path)))
    for body in world.bodies:
        mass, center, inertia = body.boxes.mass_properties()
        told = model.body(body.name)
        turn = Rotation.from_quat(np.roll(told.iquat, -1)).as_matrix()
        assert mass == pytest.approx(told.mass[0], rel=1e-6)
        assert mass == pytest.approx(DENSITY * np.prod(body.boxes.sizes, axis=1).sum())
        assert center == pytest.approx(told.ipos, abs=1e-7)
        assert inertia == pytest.approx(turn @ np.diag(told.inertia) @ turn.T, rel=1e-5, abs=1e-9)


def test_only_what_lies_just_beneath_carries() -> None:
    floor = slab(np.array([0.0, 0.0, 1.0]), 0.0, np.zeros(3), 5.0)
    wall = slab(np.array([0.0, 1.0, 0.0]), -0.1, np.zeros(3), 5.0)
    assert floor.high[0, 2] == 0.0
    assert np.linalg.det(wall.axes) == pytest.approx(1.0)

    def stands(lowest: float, height: float, x: float, on: Boxes) -> bool:
        return carried(np.array([[x, 0.0, lowest], [x, 0.0, lowest + height]]), [on])

    assert stands(0.02, 0.3, 0.0, floor)
    assert not stands(0.04, 0.3, 0.0, floor)
    assert stands(0.1, 2.5, 0.0, floor)  # a twentieth of its height is more
    assert stands(-0.02, 0.3, 0.0, floor)
    assert not stands(0.02, 0.3, 9.0, floor)  # beside it
    assert not stands(0.02, 0.3, 0.0, wall)


def test_boxes_give_way_at_their_sides_alone() -> None:
    first = Boxes(np.eye(3), np.array([[0.0, 0.0, 0.0]]), np.array([[1.0, 1.0, 1.0]]))
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()

    def highest(low: tuple[float, ...], high: tuple[float, ...], axes: Floats = first.axes) -> Floats:
        return apart(first, Boxes(axes, np.array([low]), np.array([high]))).high[0]

    assert highest((0.98, 0.2, 0.2), (1.5, 0.8, 0.8)) == pytest.approx([0.98, 1.0, 1.0])
    # Axes (y, -x): from 0.97 to 1.5 along x.
    assert highest((0.2, -1.5, 0.2), (0.8, -0.97, 0.8), turned) == pytest.approx([0.97, 1.0, 1.0])
    assert highest((0.2, 0.2, 0.98), (0.8, 0.8, 1.5)) == pytest.approx([1.0, 1.0, 1.0])  # it stands on it
    assert highest((0.8, 0.2, 0.2), (1.5, 0.8, 0.8)) == pytest.approx([1.0, 1.0, 1.0])  # too far in
    assert highest((1.01, 0.2, 0.2), (1.5, 0.8, 0.8)) == pytest.approx([1.0, 1.0, 1.0])


# Bodies.


def test_names_are_safe_and_unlike_each_other() -> None:
    assert [body.name for body in room().bodies] == ["Tisch", "Stuhl_2_a", "mug", "mug_2", "Bild_1_2", "MUG_3"]
    given = ["", "椅子", "7 up", "world", "floor_0", "a-b", "a b"]
    things = [thing(name, block((0, 0, 0), (0.1, 0.1, 0.1)), pose(k, 0, 0)) for k, name in enumerate(given)]
    world = World(things, up(), [], METERS, np.zeros((0, 3)), 0.02)
    expected = ["thing", "thing_2", "thing_7_up", "world_2", "floor_0_2", "a_b", "a_b_2"]
    assert [body.name for body in world.bodies] == expected


def test_the_world_has_z_up_meters_and_the_floor_at_zero() -> None:
    world = room()
    for body, (mesh, T, _) in zip(world.bodies, ROOM, strict=True):
        heights = corners_of(world)[body.name][:, 2]
        assert heights == pytest.approx(T.apply(torch.from_numpy(mesh.vertices.copy()))[:, 2].numpy(), abs=1e-6)
        assert np.linalg.det(body.R) == pytest.approx(1.0)
        assert body.vertices @ body.R.T + body.t == pytest.approx(corners_of(world)[body.name], abs=1e-9)
    assert [body.free for body in world.bodies] == [True, True, True, True, False, True]
    assert list(world.static) == ["wall_0", "floor_1", "wall_2"]


def test_without_a_floor_nothing_is_shifted() -> None:
    world = World(room().things, up(), [plane((0.0, 0.0, -1.0), -2.6)], METERS, np.zeros((0, 3)), 0.02)
    assert world.T_world_scene.translation.tolist() == [0.0, 0.0, 0.0]
    assert [body.free for body in world.bodies] == [False, False, True, True, False, False]


# Files.


def test_things_stay_where_they_are_in_mujoco(tmp_path: Path) -> None:
    world = room()
    ways = moved(write_mjcf(world, tmp_path), world.bodies)
    assert max(ways.values()) < MOVED_M
    assert ways["Bild_1_2"] == 0.0
    assert sorted(path.name for path in (tmp_path / "meshes").iterdir()) == sorted(f"{name}.obj" for name in ways)


def test_poses_that_are_a_little_wrong_move_little(tmp_path: Path) -> None:
    rng, things = np.random.default_rng(3), []
    for name, (mesh, T, unit) in zip(NAMES, ROOM, strict=True):
        turn, shift = rng.normal(size=(2, 3))
        turn *= np.radians(0.5) / np.linalg.norm(turn)
        shift *= 0.005 / np.linalg.norm(shift)
        step = torch.from_numpy(np.concatenate([turn, shift, [0.0]]))
        things.append(thing(name, mesh, T.perturb(step), unit))
    world = World(things, up(), room().boundary, METERS, np.zeros((0, 3)), 0.02)
    assert max(moved(write_mjcf(world, tmp_path), world.bodies).values()) < MOVED_M


def test_what_nothing_explains_carries_things_and_does_not_push_them(tmp_path: Path) -> None:
    """A table that no object explains, and stray points beside and in the mug on it."""
    spacing = 0.02
    points, _ = trimesh.sample.sample_surface(table(), 20_000, seed=1)
    stray = np.array([[0.045, 0.0, 0.76], [0.0, 0.0, 0.74], [-0.02, 0.0, 0.78], [0.0, 0.05, 0.8]])
    rest = T_SCENE_ROOM.apply(torch.from_numpy(np.concatenate([points, stray]))).numpy()
    things = [thing("mug", mug(), pose(0.0, 0.0, 0.7304))]
    world = World(things, up(), [plane((0.0, 0.0, 1.0), 0.0)], METERS, rest, spacing / METERS)
    assert world.bodies[0].free
    assert moved(write_mjcf(world, tmp_path), world.bodies)["mug"] < MOVED_M
    boxes = point_boxes(points, 2 * spacing)
    assert len(boxes) < 300
    bare = World(things, up(), [plane((0.0, 0.0, 1.0), 0.0)], METERS, np.zeros((0, 3)), spacing / METERS)
    assert not bare.bodies[0].free


def test_a_flat_mesh_is_a_thing_as_well(tmp_path: Path) -> None:
    """MuJoCo refuses meshes without volume, unless their inertia is told to be a shell's."""
    sheet = trimesh.Trimesh([[0, 0, 0], [0.4, 0, 0], [0.4, 0.6, 0], [0, 0.6, 0]], [[0, 1, 2], [0, 2, 3]])
    things = [thing("mat", sheet, pose(0.0, 0.0, 0.001)), thing("mug", mug(), pose(0.2, 0.3, 0.0014))]
    world = World(things, up(), room().boundary, METERS, np.zeros((0, 3)), 0.02)
    assert max(moved(write_mjcf(world, tmp_path), world.bodies).values()) < MOVED_M


def test_glb_has_a_node_for_each_thing_and_y_up(tmp_path: Path) -> None:
    world = room()
    write_glb(world, tmp_path / "world.glb")
    scene = trimesh.load_scene(tmp_path / "world.glb")
    assert set(scene.graph.nodes_geometry) == {body.name for body in world.bodies}
    for name, corners in corners_of(world).items():
        matrix, geometry = scene.graph[name]
        found = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
        expected = corners[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        assert found.min(axis=0) == pytest.approx(expected.min(axis=0), abs=1e-5)
        assert found.max(axis=0) == pytest.approx(expected.max(axis=0), abs=1e-5)


@pytest.mark.parametrize("ending", ["usda", "usd"])
def test_usd_has_bodies_and_colliders(tmp_path: Path, ending: str) -> None:
    world = room()
    path = tmp_path / f"world.{ending}"
    write_usd(world, path)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)] == []
    cache = UsdGeom.XformCache()
    for body in world.bodies:
        prim = stage.GetPrimAtPath(f"/main/{body.name}")
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI) == body.free
        visual = UsdGeom.Mesh(prim.GetChild("visual"))
        matrix = np.array(cache.GetLocalToWorldTransform(visual.GetPrim())).T
        found = trimesh.transform_points(np.array(visual.GetPointsAttr().Get()), matrix)
        assert found == pytest.approx(corners_of(world)[body.name], abs=1e-5)
        assert np.array(visual.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3).tolist() == body.faces.tolist()
        cubes = prim.GetChild("solid").GetChildren()
        assert len(cubes) == len(body.boxes)
        assert all(cube.HasAPI(UsdPhysics.CollisionAPI) for cube in cubes)
        centers = [np.array(cache.GetLocalToWorldTransform(cube))[3, :3] for cube in cubes]
        assert np.array(centers) == pytest.approx(body.boxes.centers @ body.R.T + body.t, abs=1e-6)
    floor = stage.GetPrimAtPath("/main/floor_1/solid/box_0")
    bounds = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(floor).ComputeAlignedRange()
    assert bounds.GetMax()[2] == pytest.approx(0.0, abs=1e-6)


def test_sdf_has_models_with_meshes_and_poses(tmp_path: Path) -> None:
    world = room()
    root = ElementTree.parse(write_sdf(world, tmp_path)).getroot()
    assert (root.tag, root.get("version")) == ("sdf", "1.9")
    assert root.findtext("world/gravity") == "0 0 -9.81"
    models: dict[str | None, Any] = {model.get("name"): model for model in root.iter("model")}
    assert list(models) == [*world.static, *(body.name for body in world.bodies)]
    for body in world.bodies:
        model = models[body.name]
        assert model.findtext("static") == ("0" if body.free else "1")
        x, y, z, *angles = map(float, model.findtext("pose").split())
        turn = Rotation.from_euler("xyz", angles).as_matrix()
        mesh = trimesh.load_mesh(tmp_path / model.findtext("link/visual/geometry/mesh/uri"), process=False)
        found = mesh.vertices @ turn.T + (x, y, z)
        assert found == pytest.approx(corners_of(world)[body.name], abs=1e-6)
        assert len(model.findall("link/collision")) == len(body.boxes)
        assert float(model.findtext("link/inertial/mass")) == pytest.approx(body.boxes.mass_properties()[0], rel=1e-6)


def test_mujoco_reads_the_urdf(tmp_path: Path) -> None:
    """It looks for the meshes beside the file, and joins fixed links to the world unless told not to."""
    world = room()
    text = write_urdf(world, tmp_path).read_text(encoding="utf-8")
    compiler = '<mujoco><compiler strippath="false" fusestatic="false" discardvisual="false"/></mujoco>'
    (tmp_path / "told.urdf").write_text(text.replace("</robot>", f"{compiler}</robot>"), encoding="utf-8")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "told.urdf"))
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    assert model.nmesh == len(world.bodies)
    for body in world.bodies:
        found = model.body(body.name)
        assert state.xpos[found.id] == pytest.approx(body.t, abs=1e-6)
        assert state.xmat[found.id].reshape(3, 3) == pytest.approx(body.R, abs=1e-6)
        assert found.mass[0] == pytest.approx(body.boxes.mass_properties()[0], rel=1e-5)


def test_an_empty_world_is_a_world(tmp_path: Path) -> None:
    world = World([], up(), [plane((0.0, 0.0, 1.0), 0.0)], METERS, np.zeros((0, 3)), 0.02)
    assert mujoco.MjModel.from_xml_path(str(write_mjcf(world, tmp_path))).nbody == 2
    write_usd(world, tmp_path / "world.usda")
    assert Usd.Stage.Open(str(tmp_path / "world.usda")).GetPrimAtPath("/main/floor_0")
    ElementTree.parse(write_sdf(world, tmp_path))
    ElementTree.parse(write_urdf(world, tmp_path))
