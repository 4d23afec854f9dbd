"""instant-ngp's snapshots: the cameras and the frame in them, the layout of their one vector, and what is refused."""

from __future__ import annotations

import gzip
import json
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.families import radiance_field, seen_surface
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.snapshots.instant_ngp import cameras_of, read_radiance, snapshot_of, to_dataset
from regnf_core.importing.snapshots.msgpack import read_msgpack
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.radiance import scenes
from tests.core.importing.radiance.fitted import Doubles, Fitted, Grid, fitted

SCALE, OFFSET = 1.0 / 3.0, np.array([0.5, 0.45, 0.55])
"""By the keys of transforms.json: 3 of its units are the unit cube's edge."""
GROWTH = (220 / 8) ** (1 / 7)


def into_cube(points: Doubles) -> Doubles:
    """Scaled, shifted, and x y z become y z x."""
    return (SCALE * points + OFFSET)[:, [1, 2, 0]]


def from_cube(points: Doubles) -> Doubles:
    return (points[:, [2, 0, 1]] - OFFSET) / SCALE


@cache
def density() -> Fitted:
    points = into_cube(scenes.places())
    kept = points[((points > 0.0) & (points < 1.0)).all(axis=1)]
    return fitted(Grid(tiny=True), lambda cube: SCALE * scenes.distance(from_cube(cube)), kept, kept, 1.0)


def pose_in_cube(pose: Doubles) -> list[list[float]]:
    """Of a pose in transforms.json: OpenCV's axes, in the cube."""
    columns = pose[:3] * [1.0, -1.0, -1.0, 1.0]
    columns[:, 3] = SCALE * columns[:, 3] + OFFSET
    return columns[[1, 2, 0]].tolist()


def snapshot(fitted_: Fitted | None = None, **more: Any) -> dict[str, Any]:
    """As the program saves it. more: other values, by their paths with __ between keys."""
    found = fitted_ or density()
    color = np.random.default_rng(3).normal(size=64 * 32 + 64 * 64 + 16 * 64)
    params = np.concatenate([found.network.first.ravel(), found.network.last.ravel(), color, found.table.ravel()])
    poses = [pose_in_cube(pose) for pose in scenes.cameras(8)]
    seen = {"focal_length": [500.0, 500.0], "principal_point": [0.5, 0.5], "resolution": [640, 480], "lens": {}}
    dataset = {"n_images": len(poses), "paths": [], "metadata": [seen] * len(poses), "aabb_scale": 1}
    dataset |= {"xforms": [{"start": pose, "end": pose} for pose in poses], "scale": SCALE, "offset": OFFSET.tolist()}
    box = {"min": [0.0] * 3, "max": [1.0] * 3}
    network = {"otype": "FullyFusedMLP", "activation": "ReLU", "output_activation": "None", "n_neurons": 64}
    grid = found.grid
    tree: dict[str, Any] = {
        "dir_encoding": {"otype": "Composite", "nested": [{"otype": "SphericalHarmonics", "degree": 4}]},
        "encoding": {
            "otype": "HashGrid",
            "n_levels": grid.levels,
            "n_features_per_level": grid.features,
            "log2_hashmap_size": grid.log2,
            "base_resolution": grid.base,
            "per_level_scale": GROWTH,
        },
        "network": {**network, "n_hidden_layers": 1},
        "rgb_network": {**network, "n_hidden_layers": 2},
        "snapshot": {
            "aabb": box,
            "render_aabb": box,
            "mode": "nerf",
            "nerf": {"aabb_scale": 1, "dataset": {**dataset, "from_mitsuba": False}},
            "params_binary": params.astype(np.float16).tobytes(),
            "params_type": "__half",
            "training_step": 35000,
            "version": 1,
        },
    }
    for path, value in more.items():
        *above, last = path.split("__")
        here = tree
        for part in above:
            here = here[part]
        here[last] = value
    return tree


def written(path: Path, tree: dict[str, Any], packed: bool = True) -> Path:
    data = msgpack.packb(tree)
    path.write_bytes(gzip.compress(data, 1) if packed else data)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a snapshot was converted, in the frame of transforms.json, with nothing beside it; coarsely, for speed."""
    found = tmp_path_factory.mktemp("ngp")
    written(found / "upload", snapshot())
    with pytest.MonkeyPatch.context() as patch:
        for module in (radiance_field, seen_surface):
            patch.setattr(module, "VOXELS", 128)
        report = convert_file(found / "upload", found, {"frame": "dataset"}, ImportLimits())
    (found / "report.json").write_text(json.dumps(report))
    return found


def test_a_snapshot_is_seen_by_its_own_cameras(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    assert report["family"] == "instant_ngp"
    assert "step 35000: 8 levels of 2, 2 layers" in report["why"][0]
    assert "8 of the 8 cameras" in report["why"][1]
    assert [line.partition(":")[0] for line in report["warnings"]] == ["SURFACE_RECONSTRUCTED"]


def test_distances_are_in_the_frame_of_transforms_json(folder: Path) -> None:
    field = open_field(folder / FIELD_NAME)
    random = np.random.default_rng(1)
    points = random.uniform([-0.6, -0.6, -0.33], [0.6, 0.6, 0.2], (40_000, 3))
    truth = scenes.distance(points)
    near = np.abs(truth) < 0.02
    off = field.signed_distance(torch.from_numpy(points[near]).float()).numpy() - truth[near]
    assert abs(np.median(off)) < 0.02
    assert np.quantile(np.abs(off), 0.8) < 0.035
    assert (field.signed_distance(torch.from_numpy(points[truth > 0.12]).float()) > 0).all()


def radiance_of(tree: dict[str, Any], said: dict[str, Any] | None = None) -> Any:
    keys = snapshot_of(read_msgpack(memoryview(msgpack.packb(tree))))
    return read_radiance(keys, 1 << 30, UploadDescription.from_dict(said))


@pytest.mark.parametrize("kind", ["__half", "float"])
@pytest.mark.parametrize("columns", [32, 48])
def test_the_density_is_that_of_the_formulas(kind: str, columns: int) -> None:
    """48: of the color network, where images have latent codes."""
    found = density()
    color = np.zeros(64 * columns + 64 * 64 + 16 * 64)
    params = np.concatenate([found.network.first.ravel(), found.network.last.ravel(), color, found.table.ravel()])
    data = params.astype(np.float16 if kind == "__half" else np.float32).tobytes()
    latent = {"snapshot__nerf__dataset__n_extra_learnable_dims": columns - 32}
    radiance = radiance_of(snapshot(snapshot__params_type=kind, snapshot__params_binary=data, **latent))
    points = np.random.default_rng(2).uniform(0.01, 0.99, (500, 3))
    wanted = found.exponent(points)
    atol = 0.1 if kind == "__half" else 2e-3
    np.testing.assert_allclose(np.log(radiance.field.density(points)), wanted, atol=atol)
    assert (radiance.field.density(points + 1.0) == 0.0).all()


def test_the_growth_follows_from_the_box_where_it_is_not_said() -> None:
    """2048 nodes along the unit cube: (2048 x 4 / 16)^(1 / 7) = 2.4380 of 8 levels in a box of 4."""
    grid = Grid(tiny=True, levels=8, features=2, log2=12, base=16, top=8192)
    tree = snapshot(
        Fitted(grid, density().network, np.zeros((grid.rows, 2), np.float32)),
        encoding__per_level_scale=0.0,
        snapshot__nerf__aabb_scale=4,
        snapshot__aabb={"min": [-1.5] * 3, "max": [2.5] * 3},
        snapshot__render_aabb={"min": [0.0] * 3, "max": [1.0, 1.0, 0.5]},
    )
    radiance = radiance_of(tree)
    scales = [level.scale for level in radiance.field.levels]
    np.testing.assert_allclose(scales, [16 * 2.4380**level - 1 for level in range(8)], rtol=2e-4)
    assert radiance.reach[0].tolist() == [0.0] * 3
    assert radiance.reach[1].tolist() == [1.0, 1.0, 0.5]


def test_poses_and_frame_are_those_of_transforms_json() -> None:
    keys = snapshot_of(read_msgpack(memoryview(msgpack.packb(snapshot()))))
    to = np.array(to_dataset(keys))
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    np.testing.assert_allclose(into_cube(points) @ to[:3, :3].T + to[:3, 3], points, atol=1e-12)
    cameras = cameras_of(keys)
    for pose, wanted in zip(cameras.poses, scenes.cameras(8), strict=True):
        back = to @ pose
        back[:3, :3] *= SCALE
        np.testing.assert_allclose(back, wanted @ np.diag([1.0, -1.0, -1.0, 1.0]), atol=1e-9)
    np.testing.assert_allclose(cameras.focal[0], [500 / 640, 500 / 480])
    np.testing.assert_allclose(cameras.middle[0], [0.5, 0.5])
    bare = snapshot(snapshot__nerf__dataset__xforms=[pose_in_cube(pose) for pose in scenes.cameras(8)])
    older = cameras_of(snapshot_of(read_msgpack(memoryview(msgpack.packb(bare)))))
    np.testing.assert_array_equal(older.poses, cameras.poses)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"snapshot__mode": "sdf"}, "FAMILY_NOT_SUPPORTED"),
        ({"snapshot__version": 0}, "FAMILY_NOT_SUPPORTED"),
        ({"snapshot__nerf__dataset": None}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__otype": "Frequency"}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__type": "Dense"}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__hash": "Rng"}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__interpolation": "Nearest"}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__n_levels": 7}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__n_levels": 99}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__per_level_scale": 0.5}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__per_level_scale": 0.0, "snapshot__nerf__aabb_scale": 1e-9}, "SETTINGS_CONTRADICT_TENSORS"),
        ({"snapshot__aabb": {"min": [-1e300] * 3, "max": [1e300] * 3}}, "BOUNDS_INVALID"),
        ({"network__activation": "Sine"}, "FAMILY_NOT_SUPPORTED"),
        ({"network__otype": "CutlassMLP"}, "FAMILY_NOT_SUPPORTED"),
        ({"dir_encoding__nested": [{"otype": "HashGrid"}]}, "FAMILY_NOT_SUPPORTED"),
        ({"encoding__log2_hashmap_size": 16}, "SETTINGS_CONTRADICT_TENSORS"),
        ({"network__n_neurons": 32}, "SETTINGS_CONTRADICT_TENSORS"),
        ({"network__n_hidden_layers": 0}, "SETTINGS_CONTRADICT_TENSORS"),
        ({"rgb_network__n_neurons": 0}, "SETTINGS_CONTRADICT_TENSORS"),
        ({"snapshot__params_type": "double"}, "TENSOR_EXPECTED"),
        ({"snapshot__params_binary": [1, 2]}, "TENSOR_EXPECTED"),
        ({"snapshot__params_binary": b"\xff\xff" * 1000}, "TENSOR_NOT_FINITE"),
        ({"snapshot__aabb": {"min": [1.0] * 3, "max": [0.0] * 3}}, "BOUNDS_INVALID"),
        ({"snapshot__nerf__dataset__xforms": []}, "CAMERAS_MALFORMED"),
        ({"snapshot__nerf__dataset__metadata": [{}] * 8}, "CAMERAS_MALFORMED"),
        ({"snapshot__nerf__dataset__xforms": [3] * 8}, "SETTINGS_MALFORMED"),
    ],
)
def test_what_cannot_be_read_is_refused(more: dict[str, Any], reason: str, tmp_path: Path) -> None:
    written(tmp_path / "upload", snapshot(**more), packed=False)
    with pytest.raises(FieldFormatError) as caught:
        convert_file(tmp_path / "upload", tmp_path, None, ImportLimits())
    assert caught.value.reason == reason, str(caught.value)
    if reason == "FAMILY_NOT_SUPPORTED":
        assert "export its mesh" in str(caught.value)


def test_snapshots_are_told_by_their_first_bytes(tmp_path: Path) -> None:
    for packed in (True, False):
        head = written(tmp_path / "a", snapshot(), packed).read_bytes()[:HEAD_BYTES]
        assert sniff_format(head) == "instant-ngp"
    assert sniff_format(gzip.compress(b"# a text\n" * 100)) == "gzip"
    assert sniff_format(msgpack.packb({"params": {"a": 1}})) is None


def test_a_truncated_snapshot_in_an_archive(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "run.zip", "w") as archive:
        archive.writestr("lego/base.ingp", written(tmp_path / "a", snapshot()).read_bytes()[:-500])
        archive.writestr("lego/transforms.json", json.dumps(scenes.transforms(scenes.cameras(3))))
    with pytest.raises(FieldFormatError) as caught:
        convert_file(tmp_path / "run.zip", tmp_path, None, ImportLimits())
    assert caught.value.reason == "FILE_TRUNCATED"
