import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from regnf_core.errors import DatasetError, FitDivergedError, InvalidInputError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import has_color, observation_of
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description
from regnf_fit.images import fit
from regnf_fit.images.coloring import RadianceField
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.fusion import map_distances
from regnf_fit.images.preparation import prepare
from regnf_fit.options import LossWeights, ReconstructionOptions
from tests.core.importing.in_process import convert
from tests.fit.images import scenes

SMALL = ReconstructionOptions(
    grid=HashGridConfig.from_top_resolution(512, levels=8, log2_table_size=12),
    hidden_width=32,
    iterations=250,
    map_points=768,
    surface_rays=192,
    free_points=384,
    eikonal_points=256,
    color_rays=24,
    rays_without_depth=128,
)


class StoppedError(Exception):
    """Raised in a fit's progress, as a user's interruption is."""


def surface_errors(field, distance):
    """Mean |distance| in diagonals at true surface points, and the share of clearly free points taken for matter."""
    rng = np.random.default_rng(5)
    points = rng.uniform(*scenes.BOUNDS, size=(200_000, 3))
    exact = distance(points)
    near = np.abs(exact) < 0.01
    told = field.signed_distance(torch.from_numpy(points).float()).numpy()
    matter = (told[exact > 0.08] < 0.0).mean()
    return np.abs(told - exact)[near].mean() / scenes.SIZE, matter


def test_a_ball_and_a_box_from_eight_depth_images(tmp_path):
    path = tmp_path / "field.safetensors"
    files, options = FitFiles(path, snapshots=(0.03,), pictures=True), replace(SMALL, iterations=300)
    report = reconstruct(scenes.images(), files, options, device="cpu", label="two")
    error, matter = surface_errors(open_field(path), scenes.distance)
    assert error < 0.004
    assert matter == 0.0
    assert has_color(open_field(path))
    assert report.psnr is not None
    assert report.ssim is not None
    assert report.depth_error_median is not None
    assert report.depth_error_median < 0.01 * scenes.SIZE
    description = read_description(path)
    assert description["label"] == "two"
    assert np.allclose(description["bounds"], scenes.BOUNDS)
    assert {"field.png", "field-after-10-percent.png"} <= {each.name for each in tmp_path.iterdir()}
    early, _ = surface_errors(open_field(tmp_path / "field-after-3-percent.safetensors"), scenes.distance)
    assert early > 2.0 * error


@pytest.mark.long
def test_colors_alone_find_the_ball(tmp_path):
    images = replace(scenes.images(count=12, ball_alone=True), depths=None)
    path = tmp_path / "field.safetensors"
    short, whole = replace(SMALL, iterations=5), replace(SMALL, iterations=150)
    first = reconstruct(images, FitFiles(tmp_path / "first.safetensors"), short, device="cpu")
    report = reconstruct(images, FitFiles(path), whole, device="cpu")
    assert report.psnr is not None
    assert report.psnr > (first.psnr or 0.0) + 3.0
    error, _ = surface_errors(open_field(path), scenes.ball_distance)
    assert error < 0.03


@pytest.mark.long
def test_an_interrupted_fit_ends_as_if_it_had_not_been(tmp_path):
    options, images = replace(SMALL, iterations=30, refine_poses=True), scenes.images(count=4)
    whole, parts = tmp_path / "whole.safetensors", tmp_path / "parts.safetensors"
    reconstruct(images, FitFiles(whole), options, device="cpu")
    files = FitFiles(parts, tmp_path / "state.checkpoint")

    def stop(iteration, loss, seconds_left):
        if iteration == 18:
            raise StoppedError

    with pytest.raises(StoppedError):
        reconstruct(images, files, options, device="cpu", progress=stop)
    assert files.checkpoint.exists()
    assert not parts.exists()
    reported = []
    reconstruct(images, files, options, device="cpu", progress=lambda done, *_: reported.append(done))
    assert reported[0] > 15
    assert parts.read_bytes() == whole.read_bytes()
    assert not files.checkpoint.exists()


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    images = scenes.images(count=4)
    files = FitFiles(tmp_path / "field.safetensors", tmp_path / "state.checkpoint")
    options = replace(SMALL, iterations=20)

    def stop(iteration, loss, seconds_left):
        raise StoppedError

    with pytest.raises(StoppedError):
        reconstruct(images, files, options, device="cpu", progress=lambda i, *_: stop(i, 0, 0) if i == 4 else None)
    with pytest.raises(InvalidInputError) as caught:
        reconstruct(images, files, options, seed=1, device="cpu")
    assert caught.value.reason == "CHECKPOINT_OF_ANOTHER_FIT"
    files.checkpoint.write_bytes(b"no checkpoint")
    with pytest.raises(InvalidInputError) as caught:
        reconstruct(images, files, options, device="cpu")
    assert caught.value.reason == "CHECKPOINT_INVALID"


def test_a_fit_that_diverges_says_so_and_writes_no_field(tmp_path):
    options = replace(SMALL, iterations=20, weights=LossWeights(surface=float("inf")))
    files = FitFiles(tmp_path / "field.safetensors", snapshots=(0.05,), pictures=True)
    with pytest.raises(FitDivergedError) as caught:
        reconstruct(scenes.images(count=4), files, options, device="cpu")
    assert caught.value.reason == "FIT_DIVERGED"
    assert list(tmp_path.iterdir()) == []


def test_a_world_beyond_the_grid_is_fitted_in_a_frame_of_its_own(tmp_path):
    """A room in a robot's map: the field, its exports and the report are in the robot's frame."""
    origin, scale = (3.0, 5.0, 0.0), 5.0
    images, path, exported = scenes.images(count=6), tmp_path / "field.safetensors", tmp_path / "step.ckpt"
    world = images.moved(-np.array(origin) / scale, scale)
    options = replace(SMALL, iterations=100, half_table=False)
    report = reconstruct(world, FitFiles(path, sdfstudio=exported), options, device="cpu")
    field = open_field(path)
    np.testing.assert_allclose(field.bounds.numpy(), world.bounds, atol=1e-5)
    points = np.random.default_rng(0).uniform(*scenes.BOUNDS, size=(2000, 3))
    told = field.signed_distance(torch.from_numpy(scale * points + origin).float()).numpy()
    assert np.median(np.abs(told / scale - scenes.distance(points))) < 0.03
    assert report.depth_error_median < 0.1 * scale
    assert observation_of(field) is not None
    placed = json.loads((tmp_path / "dataparser_transforms.json").read_text())
    corner = placed["scale"] * (np.array(placed["transform"]) @ [*world.bounds[0], 1.0])
    low = torch.load(exported, weights_only=True)["pipeline"]["_model.field.aabb"][0]
    np.testing.assert_allclose(corner, low, atol=1e-5)


def test_the_exported_layout_reads_back(tmp_path):
    path, exported = tmp_path / "field.safetensors", tmp_path / "step.ckpt"
    options = replace(SMALL, iterations=40, half_table=False)
    files = FitFiles(path, sdfstudio=exported)
    reconstruct(scenes.images(count=4), files, options, device="cpu")
    report = convert(exported, tmp_path / "imported", settings=tmp_path / "config.yml")
    assert report["family"] == "sdfstudio_neus_facto", report
    imported = open_field(next((tmp_path / "imported").glob("*.safetensors")))
    points = torch.from_numpy(np.random.default_rng(0).uniform(*scenes.BOUNDS, size=(500, 3))).float()
    told, gradient = open_field(path).signed_distance_and_gradient(points)
    again, gradient_again = imported.signed_distance_and_gradient(points)
    torch.testing.assert_close(again, told, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(gradient_again, gradient, atol=1e-3, rtol=0.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"T_world_camera": np.full((4, 4, 4), np.nan)}, "DATASET_POSE_NOT_RIGID"),
        ({"intrinsics": np.zeros((4, 3, 3))}, "DATASET_INTRINSICS_INVALID"),
        ({"bounds": np.zeros((2, 3))}, "DATASET_BOUNDS_EMPTY"),
        ({"depths": np.zeros((4, 36, 48), np.float32)}, "DATASET_DEPTH_MISSING"),
        ({"depths": None, "colors": np.full((4, 36, 48, 3), 9, np.uint8)}, "DATASET_NO_COLOR_VARIETY"),
        ({"bounds": np.array([[1.0, 1.0, 1.0], [1.1, 1.1, 1.1]])}, "DATASET_NOTHING_IN_BOUNDS"),
    ],
)
def test_images_with_nothing_to_go_by_are_refused(tmp_path, change, reason):
    path = tmp_path / "field.safetensors"
    with pytest.raises(DatasetError) as caught:
        reconstruct(replace(scenes.images(count=4), **change), FitFiles(path), SMALL, device="cpu")
    assert caught.value.reason == reason
    assert list(tmp_path.iterdir()) == []


def test_the_field_is_positive_round_the_start_and_a_room_the_other_way_round():
    for kind, sign in (("object", 1.0), ("room", -1.0)):
        start = prepare(scenes.images(count=4), kind, np.random.default_rng(0)).start
        field = RadianceField(SMALL, start, torch.Generator().manual_seed(0))
        with torch.no_grad():
            middle, corner = field.function().value(torch.tensor([[0.0, 0.0, 0.0], [1.2, 1.2, 1.2]]))
        assert sign * float(corner) > 0.0 > sign * float(middle)


@pytest.mark.parametrize(
    ("start", "refine_poses", "maps"), [("room", False, 1), ("object", False, 0), ("room", True, 0)]
)
def test_rooms_learn_from_the_map_of_their_depths(tmp_path, monkeypatch, start, refine_poses, maps):
    made = []

    def counted(*given):
        made.append(map_distances(*given))
        return made[-1]

    monkeypatch.setattr(fit, "map_distances", counted)
    options = replace(SMALL, iterations=2, start=start, refine_poses=refine_poses)
    reconstruct(scenes.images(count=4), FitFiles(tmp_path / "field.safetensors"), options, device="cpu")
    assert len(made) == maps
