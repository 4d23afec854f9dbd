"""Make the demo's fields from open meshes: a furnished room, and two chairs of the library.

    python scripts/make_demo_fields.py MESHES ROOM.json [--out examples/data] [--only NAME] [--iterations N]

MESHES holds the meshes that the room's instances name; ROOM.json lists floor, walls and instances (a pose each). Beside
the fields it writes each chair's detection in the room and its true transform, and what the fits measured.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.solids import BoxField, UnionField
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.importing.mesh_file import load_mesh
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_fit.mesh import fit_field
from regnf_fit.options import FitOptions

OBJECT_UNITS_PER_METER = 0.625
"""1.25 object units a scene unit: the scale that the registration has to find."""
LIBRARY = {"armchair": ("fc", ""), "dining-chair": ("dc", "-dining-chair")}
"""Library objects: the room's instance that shows each, and how its detection and truth files end."""
ATTRIBUTION = "Poly Haven, https://polyhaven.com, CC0 1.0"


@dataclass(frozen=True)
class SceneFrame:
    """A scene's frame: meters in the room's frame, less ``origin_m``, times ``units_per_meter``."""

    units_per_meter: float = 0.5
    origin_m: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @classmethod
    def of(cls, room: dict[str, Any]) -> SceneFrame:
        """The frame that a layout asks for, or the usual one."""
        usual = cls()
        origin = room.get("scene_origin_m", usual.origin_m)
        return cls(room.get("scene_units_per_meter", usual.units_per_meter), tuple(origin))

    def from_room(self) -> NDArray[np.float64]:
        """(4, 4): meters in the room's frame to scene units."""
        return scale_and_shift(self.units_per_meter, -self.units_per_meter * np.array(self.origin_m))

    def points(self, meters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) of the room's frame in scene units."""
        matrix = self.from_room()
        moved: NDArray[np.float64] = meters @ matrix[:3, :3].T + matrix[:3, 3]
        return moved


SCENE_FRAME = SceneFrame()

ROOM_OPTIONS = FitOptions(
    grid=HashGridConfig.from_top_resolution(512, levels=10, log2_table_size=17),
    iterations=4000,
    batch=4096,
    gradient_batch=1024,
    near_points=900_000,
    volume_points=200_000,
    noise=(0.0008, 0.004, 0.02),
    padding=0.1,
    margin=0.01,
)
CHAIR_OPTIONS = FitOptions(
    grid=HashGridConfig.from_top_resolution(1024, levels=10, log2_table_size=15),
    iterations=4000,
    batch=4096,
    gradient_batch=1024,
    near_points=500_000,
    volume_points=100_000,
)


def scale_and_shift(scale: float, shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """The (4, 4) matrix of x -> scale x + shift."""
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = shift
    return matrix


def object_from_mesh(mesh: MeshField, units_per_meter: float = OBJECT_UNITS_PER_METER) -> NDArray[np.float64]:
    """(4, 4): meters in the mesh's frame to object units, the bounding box's center moved to the origin."""
    return scale_and_shift(units_per_meter, -units_per_meter * mesh.bounds.mean(dim=0).numpy())


def load_instance(meshes: Path, instance: dict[str, Any]) -> MeshField:
    """An instance's mesh in its own frame, meters."""
    return load_mesh(meshes / Path(instance["mesh"]).name)


def compose_room(meshes: Path, room: dict[str, Any]) -> UnionField:
    """The furnished room in scene units: exact boxes for floor and walls, every instance's mesh at its pose."""
    frame = SceneFrame.of(room)
    parts: list[SdfField] = []
    weights: list[float] = []
    floor_bottom = room["floor"]["box_min"][2]
    for box in [room["floor"], *room["walls"]]:
        # Walls reach down through the floor: two solids that only touched would have a false surface between them.
        lower = np.array([*box["box_min"][:2], floor_bottom])
        corners = frame.points(np.stack((lower, box["box_max"])))
        parts.append(BoxField(*(tuple(corner) for corner in corners.tolist())))
        weights.append(0.1)
    for instance in room["instances"]:
        mesh = load_instance(meshes, instance)
        parts.append(mesh.transformed(frame.from_room() @ np.array(instance["T_room_from_object"])))
        weights.append(0.25 if instance["class"] == "chair" else 0.1)
    return UnionField(parts, weights)


def detection(instance: dict[str, Any], frame: SceneFrame = SCENE_FRAME) -> dict[str, Any]:
    """The instance's axis-aligned box in scene units."""
    lower, upper = frame.points(np.array([instance["aabb_min"], instance["aabb_max"]]))
    return {
        "center": ((lower + upper) / 2.0).tolist(),
        "size": (upper - lower).tolist(),
        "rotation_quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
        "label": "chair",
        "score": 1.0,
    }


def truth(
    instance: dict[str, Any],
    mesh: MeshField,
    units_per_meter: float = OBJECT_UNITS_PER_METER,
    frame: SceneFrame = SCENE_FRAME,
) -> dict[str, Any]:
    """The true transform from scene to object, and the object's diameter (largest distance of two vertices)."""
    T_room_mesh = np.array(instance["T_room_from_object"])
    matrix = object_from_mesh(mesh, units_per_meter) @ np.linalg.inv(frame.from_room() @ T_room_mesh)
    scale = units_per_meter / frame.units_per_meter
    rotation = Rotation.from_matrix(matrix[:3, :3] / scale)
    matrix[:3, :3] = scale * rotation.as_matrix()
    vertices = mesh.vertices * units_per_meter
    diameter = max(float(np.linalg.norm(vertices - vertex, axis=1).max()) for vertex in vertices)
    return {
        "T_object_scene": {
            "matrix": matrix.tolist(),
            "scale": scale,
            "rotation_quaternion_xyzw": rotation.as_quat().tolist(),
            "translation": matrix[:3, 3].tolist(),
        },
        "object_diameter": diameter,
    }


def fit(
    target: SdfField,
    path: Path,
    options: FitOptions,
    label: str,
    made_from: list[str],
    attribution: str = ATTRIBUTION,
) -> None:
    """Fit one field, and keep what was measured beside the others' figures."""

    def show(iteration: int, loss: float, seconds_left: float) -> None:
        print(f"{path.name}: iteration {iteration}, loss {loss:.5f}, {seconds_left:.0f} s left", flush=True)

    source = {"meshes": made_from, "attribution": attribution}
    report = fit_field(target, path, options, seed=0, progress=show, label=label, source=source)
    path.with_suffix(".fit.json").write_text(json.dumps(asdict(report), indent=1) + "\n")
    print(path.name, report, f"{path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    """Make the fields."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("room", type=Path)
    parser.add_argument("--out", type=Path, default=Path("examples/data"))
    parser.add_argument("--only", choices=("mix-room", *LIBRARY))
    parser.add_argument("--iterations", type=int, help="instead of the usual number")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    room = json.loads(arguments.room.read_text())
    change = {"iterations": arguments.iterations} if arguments.iterations else {}
    for name, (identifier, suffix) in LIBRARY.items():
        if arguments.only not in (None, name):
            continue
        instance = next(i for i in room["instances"] if i["id"] == identifier)
        chair = load_instance(arguments.meshes, instance)
        for kind, content in (("detection", detection(instance)), ("truth", truth(instance, chair))):
            (arguments.out / f"{kind}{suffix}.json").write_text(json.dumps(content, indent=1) + "\n")
        target = chair.transformed(object_from_mesh(chair))
        path = arguments.out / f"{name}.safetensors"
        fit(target, path, replace(CHAIR_OPTIONS, **change), "chair", [Path(instance["mesh"]).stem])
    if arguments.only in (None, "mix-room"):
        names = sorted({Path(i["mesh"]).stem for i in room["instances"]})
        path = arguments.out / "mix-room.safetensors"
        fit(compose_room(arguments.meshes, room), path, replace(ROOM_OPTIONS, **change), "mix-room", names)


if __name__ == "__main__":
    main()
