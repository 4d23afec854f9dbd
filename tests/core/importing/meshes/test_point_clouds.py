"""Point clouds as uploads: the surface between the points against the formula it was sampled from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.fields.mesh import MeshField
from regnf_core.importing.families import cloud as clouds
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.meshes.cloud_normals import oriented
from regnf_core.importing.meshes.point_files import read_pcd
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import saved
from tests.core.importing.in_process import convert
from tests.core.importing.meshes import mesh_files

DIAGONAL = 3**0.5


def directions(count: int) -> NDArray[np.float64]:
    """Spread evenly over the unit sphere."""
    turn, height = np.pi * (1 + 5**0.5) * np.arange(count), 1 - (2 * np.arange(count) + 1) / count
    ring = np.sqrt(1 - height**2)
    return np.stack((ring * np.cos(turn), ring * np.sin(turn), height), axis=1)


def ply(points: NDArray[np.float64], normals: NDArray[np.float64] | None = None) -> bytes:
    names = ("x", "y", "z") + (() if normals is None else ("nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    return header.encode() + np.hstack([points] + ([] if normals is None else [normals])).astype("<f4").tobytes()


def converted(data: bytes) -> ConvertedField:
    return convert_mesh("ply", memoryview(data), UploadDescription())


def field_of(found: ConvertedField) -> MeshField:
    return MeshField(found.tensors["vertices"], found.tensors["faces"])


def test_points_at_one_place_are_compared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """100,000 of them, each compared with each, took longer than any import may."""
    built: list[NDArray[np.float64]] = []

    def tree(places: NDArray[np.float64]) -> Any:
        built.append(places)
        return cKDTree(places)

    monkeypatch.setattr(clouds, "cKDTree", tree)
    around = directions(400)
    again = np.concatenate((around, around[:20].repeat(50, axis=0)))
    assert len(field_of(converted(ply(again, again))).faces) > 1000
    assert len(built[0]) == 400


def test_points_on_a_sphere_are_a_sphere(tmp_path: Path) -> None:
    around = directions(3000)
    upload = saved(tmp_path, ply(100.0 + 0.5 * around, 3.0 * around))  # elsewhere, with normals of any length
    report = convert(upload, tmp_path / "out", {"label": "ball"})
    assert (report["family"], report["label"]) == ("point_cloud", "ball")
    assert report["why"][0] == "a ply file: 3000 points with normals"
    assert [warning.split(":")[0] for warning in report["warnings"]] == ["SURFACE_RECONSTRUCTED"]
    points = 100.0 + torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 1.4 - 0.7
    distance, gradient = open_field(tmp_path / "out" / "field.safetensors").signed_distance_and_gradient(points)
    radius = (points - 100.0).norm(dim=1)
    torch.testing.assert_close(distance, radius - 0.5, rtol=0, atol=0.002 * DIAGONAL)
    assert ((gradient * (points - 100.0)).sum(dim=1) / radius)[radius > 0.1].min() > 0.98


def test_where_no_points_are_there_is_no_surface() -> None:
    """Poisson's surface is closed; the half of it that nobody measured is cut away."""
    around = directions(3000)
    seen = around[around[:, 2] > 0]
    field = field_of(converted(ply(0.5 * seen, seen)))
    far = torch.tensor([[0.0, 0.0, -0.5], [0.0, 0.0, -0.3]])
    assert (field.signed_distance(far).abs() > 0.25).all()
    assert field.signed_distance(torch.tensor([[0.0, 0.0, 0.5]])).abs().item() < 0.005


LINE = np.linspace(0.0, 1.0, 500)[:, None] * [1.0, 2.0, 3.0]
HALF_ZERO = np.where(np.arange(2000)[:, None] % 2 == 0, directions(2000), 0.0)


@pytest.mark.parametrize(
    ("points", "normals", "reason", "says"),
    [
        (directions(50), directions(50), "POINT_CLOUD_TOO_SMALL", "50 of 50 points"),
        (np.full((500, 3), np.nan), directions(500), "POINT_CLOUD_TOO_SMALL", "500 points with NaN or infinity"),
        (
            np.zeros((500, 3)),
            directions(500),
            "POINT_CLOUD_TOO_SMALL",
            "the 500 points have only 1 different positions",
        ),
        (
            np.tile(directions(9), (100, 1)),
            np.tile(directions(9), (100, 1)),
            "POINT_CLOUD_TOO_SMALL",
            "only 9 different positions",
        ),
        (LINE, directions(500), "POINT_CLOUD_TOO_SMALL", "on one line"),
        (1e-30 * directions(500), directions(500), "MESH_INVALID", "its diagonal is"),
        (np.zeros((0, 3)), None, "MESH_INVALID", "no triangles"),
    ],
)
def test_clouds_of_no_surface(
    points: NDArray[np.float64],
    normals: NDArray[np.float64] | None,
    reason: str,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Refused before the surface is made, which takes long."""
    monkeypatch.setattr(clouds, "_poisson", lambda *_: pytest.fail("a surface was made of it"))
    with pytest.raises(FieldFormatError, match=says) as caught:
        converted(ply(points, normals))
    assert caught.value.reason == reason


def test_points_without_a_normal_are_left_out_and_counted() -> None:
    found = converted(ply(directions(2000), HALF_ZERO))
    assert "ignored: 1000 points whose normals are zero, NaN or infinity" in found.why


def boxes(*sizes: tuple[float, float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """20,000 points on boxes beside each other, their normals, and the numbers of their sides."""
    random, points, normals, sides = np.random.default_rng(0), [], [], []
    areas = np.array([[size[1] * size[2], size[0] * size[2], size[0] * size[1]] for size in sizes])
    for number, size in enumerate(sizes):
        for axis in range(3):
            for sign in (-1.0, 1.0):
                count = int(10_000 * areas[number, axis] / areas.sum())
                place = (random.random((count, 3)) - 0.5) * size
                place[:, axis] = sign * size[axis] / 2
                points.append(place + np.array([2.0 * number, 0.0, 0.0]))
                normals.append(np.tile(sign * np.eye(3)[axis], (count, 1)))
                sides.append(np.full(count, 6 * number + 2 * axis + (sign > 0)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(sides)


BALL = directions(10_000)
CROSS = boxes((1.0, 1.0, 0.02), (0.02, 0.9, 0.6))
BOARDS = boxes((1.0, 1.0, 1.0), (1.0, 1.0, 0.02), (0.02, 1.0, 0.6))


def turned(normals: NDArray[np.float64], which: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.where(which[:, None], -normals, normals)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(
    ("points", "normals", "says"),
    [
        (BALL, turned(BALL, BALL[:, 2] > 0), "at the border of two patches"),
        (BALL, turned(BALL, np.prod(np.sign(BALL), axis=1) > 0), "at the border of two patches"),
        (BALL, turned(BALL, BALL[:, 0] > 0.8), "at the border of two patches"),
        (BALL, turned(BALL, np.random.default_rng(0).random(len(BALL)) < 0.5), "mixed at one place"),
        (BOARDS[0], turned(BOARDS[1], BOARDS[2] % 4 == 1), "points inward"),
    ],
)
def test_normals_that_are_turned_in_patches_are_turned_back(
    points: NDArray[np.float64], normals: NDArray[np.float64], says: str, noise: float
) -> None:
    points = points + noise * np.random.default_rng(1).normal(size=points.shape)
    found = converted(ply(points, normals))
    (warning,) = [one for one in found.warnings if one.startswith("NORMALS_TURNED")]
    assert says in warning
    assert "outside of the cloud" in warning
    within, beyond = field_of(found).signed_distance(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.5]]))
    assert within < -0.3
    assert beyond > 0.3


@pytest.mark.parametrize("spacings", [0.0, 1.0])
@pytest.mark.parametrize(
    "cloud",
    [
        *((BALL, BALL), (-BALL, BALL), BOARDS[:2], boxes((1.0, 1.0, 0.02))[:2]),
        (CROSS[0] - 2.0 * (CROSS[2] // 6)[:, None] * [1, 0, 0], CROSS[1]),
    ],
    ids=["ball", "hollow", "boards", "board", "boards that cross"],
)
@pytest.mark.parametrize("count", [1000, 9000])
def test_noisy_clouds_of_thin_boards_and_edges_are_not_taken_for_turned(
    cloud: tuple[NDArray[np.float64], NDArray[np.float64]], spacings: float, count: int
) -> None:
    random = np.random.default_rng(2)
    chosen = random.permutation(len(cloud[0]))[:count]
    points, normals = cloud[0][chosen], cloud[1][chosen]
    apart = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    assert clouds._turned(points + spacings * apart * random.normal(size=points.shape), normals) == ""


def test_who_insists_is_given_the_surface_of_turned_normals() -> None:
    half = turned(BALL, BALL[:, 2] > 0)[:3000]
    found = convert_mesh("ply", memoryview(ply(BALL[:3000], half)), UploadDescription(accept_implausible=True))
    assert found.family == "point_cloud"


def test_a_refusal_s_own_hint_comes_out_of_the_gate(tmp_path: Path) -> None:
    with pytest.raises(FieldFormatError) as caught:
        import_field(saved(tmp_path, ply(1e-30 * BALL, BALL)), tmp_path / "out")
    assert caught.value.hint == "Give the mesh in another unit, or remove stray points."


# Normals that the file does not have, or that are not of its points.


def warned(found: ConvertedField) -> list[str]:
    return [warning.split(":")[0] for warning in found.warnings]


def outward(found: ConvertedField, points: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """Share of places just outside of the true surface where the field is free, and just within where it is not."""
    step = 0.03 * np.linalg.norm(np.ptp(points, axis=0)) * normals
    field = mesh_files.field_of(found)
    before, behind = (field.signed_distance(torch.from_numpy(points + side * step).float()) for side in (1, -1))
    return float(((before > 0) & (behind < 0)).float().mean())


@pytest.mark.parametrize("shape", [(BALL, BALL), boxes((1.0, 0.6, 0.4))[:2], boxes((1.0, 1.0, 0.1))[:2]])
@pytest.mark.parametrize("known", ["nothing", "zeros", "rows exchanged", "signs exchanged"])
def test_normals_are_estimated_and_look_outside(
    shape: tuple[NDArray[np.float64], NDArray[np.float64]], known: str
) -> None:
    random = np.random.default_rng(3)
    chosen = random.permutation(len(shape[0]))[:6000]
    points, normals = shape[0][chosen] + 0.002 * random.normal(size=(len(chosen), 3)), shape[1][chosen]
    given = {
        "nothing": None,
        "zeros": 0.0 * normals,
        "rows exchanged": random.permutation(normals),
        "signs exchanged": normals * random.choice([-1.0, 1.0], (len(normals), 1)),
    }[known]
    found = converted(ply(points, given))
    turned_only = known == "signs exchanged"
    assert warned(found) == ["NORMALS_TURNED" if turned_only else "NORMALS_ESTIMATED", "SURFACE_RECONSTRUCTED"]
    assert outward(found, shape[0][chosen], normals) > 0.97


def test_the_cloud_of_a_room_is_measured_from_within() -> None:
    """A box round a smaller one that stands in it: free space is between them."""
    shell, sides, number = boxes((1.0, 1.0, 0.6), (0.2, 0.2, 0.2))
    inner = number >= 6
    points = np.where(inner[:, None], shell - [2.0, 0.0, 0.2], shell)
    normals = np.where(inner[:, None], sides, -sides)
    found = convert_mesh("ply", memoryview(ply(points)), UploadDescription(as_="scene"))
    assert "as for a scene" in found.warnings[0]
    assert outward(found, points, normals) > 0.97


def test_a_sensor_s_place_decides() -> None:
    """Half a hollow ball, measured from its middle: nothing but the sensor tells which side was seen."""
    half = BALL[BALL[:, 2] < 0.2]
    for sensor, side in (((0.0, 0.0, 0.5), -1.0), ((0.0, 0.0, -9.0), 1.0)):
        seen = half if side < 0 else half[half[:, 2] < -0.12]  # from below the rim turns away
        made = oriented(seen / 2.0, None, np.array(sensor), None)
        assert ((made.normals * seen).sum(axis=1) * side > 0).mean() > 0.99


def test_a_pcd_file_says_where_its_sensor_stood() -> None:
    def header(viewpoint: str, rows: int) -> bytes:
        body = "".join(f"{x:.5f} {y:.5f} {z:.5f}\n" for x, y, z in BALL[:400])
        head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        size = f"WIDTH {400 // rows}\nHEIGHT {rows}\nVIEWPOINT {viewpoint}\nPOINTS 400\nDATA ascii\n"
        return f"# .PCD v.7\n{head}{size}{body}".encode()

    def sensor(viewpoint: str, rows: int = 1) -> list[float] | None:
        place = read_pcd(memoryview(header(viewpoint, rows))).sensor
        return None if place is None else place.tolist()

    assert sensor("1 2 3 1 0 0 0") == [1.0, 2.0, 3.0]
    assert sensor("0 0 0 1 0 0 0") is None  # what writers put where nothing is known
    assert sensor("0 0 0 1 0 0 0", rows=20) == [0.0, 0.0, 0.0]  # a depth image, in its camera's frame
    with pytest.raises(FieldFormatError, match="invalid line"):
        sensor("a b c 1 0 0 0")
