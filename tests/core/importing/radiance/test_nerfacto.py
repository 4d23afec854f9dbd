"""nerfacto: a run with a thing on a floor, all names and layouts of its releases, and what is refused."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import ObservedField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.importing.containers.legacy_container import read_archive
from regnf_core.importing.families.nerfacto import read_radiance
from regnf_core.importing.families.radiance_field import Radiance
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.library import register
from tests.core.importing.meshes.mesh_files import field_of
from tests.core.importing.meshes.test_facing import converted
from tests.core.importing.radiance import scenes
from tests.core.importing.radiance.fitted import Doubles, looking

DATA = Path(__file__).with_name("data")
BASE = {"hash": {"base_resolution": scenes.HASH["base_res"]}}
VOXEL = 3.2 / 256
"""Of the region, whose longest edge is about 3 in the trainer's coordinates."""
SETTINGS = {
    "config.yml": scenes.config(),
    "dataparser_transforms.json": json.dumps({"transform": scenes.T_TRAINER_DATASET.tolist(), "scale": scenes.SCALE}),
}


@dataclass(frozen=True, eq=False)
class Imported:
    report: dict[str, Any]
    field: SdfField


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    """Of plain PyTorch, all files in one archive as nerfstudio leaves them, and the dataset's transforms.json."""
    folder = tmp_path_factory.mktemp("run")
    poses = [scenes.into_dataset(pose) for pose in scenes.cameras(12)]
    trained = scenes.checkpoint(folder / "trained", scenes.state_of(scenes.nerfacto(tiny=False)))
    with zipfile.ZipFile(folder / "run.zip", "w") as archive:
        for name, text in SETTINGS.items():
            archive.writestr(f"outputs/shelf/nerfacto/2024-01-01_120000/{name}", text)
        archive.write(trained, "outputs/shelf/nerfacto/2024-01-01_120000/nerfstudio_models/step-000029999.ckpt")
        archive.writestr("data/shelf/transforms.json", json.dumps(scenes.transforms(poses)))
    report = convert_file(folder / "run.zip", folder, None, ImportLimits())
    return Imported(report, open_field(folder / FIELD_NAME))


def into_dataset(points: Doubles) -> Doubles:
    turn, shift = scenes.T_TRAINER_DATASET[:, :3], scenes.T_TRAINER_DATASET[:, 3]
    return (points / scenes.SCALE - shift) @ turn


def test_a_run_is_named_for_what_it_is(run: Imported) -> None:
    assert run.report["family"] == "nerfstudio_nerfacto"
    assert "8 levels of 2, 8 to 220 nodes" in run.report["why"][1]
    assert "12 of the 12 cameras" in run.report["why"][2]
    assert any("in the dataset's frame" in line for line in run.report["why"])
    words = [line.partition(":")[0] for line in run.report["warnings"]]
    assert words == ["SURFACE_RECONSTRUCTED"]
    assert "a density, and no distance" in run.report["warnings"][0]
    assert run.report["settings"]["used"]["output_scale"] == 0.01
    assert [line.partition(":")[0] for line in run.report["assumed"]] == ["unit", "axes", "cameras"]


def test_distances_are_those_of_the_shape_in_the_datasets_frame(run: Imported) -> None:
    random = np.random.default_rng(1)
    points = random.uniform([-0.6, -0.6, -0.33], [0.6, 0.6, 0.2], (40_000, 3))
    truth = scenes.distance(points)
    near = np.abs(truth) < 0.02
    found = run.field.signed_distance(torch.from_numpy(into_dataset(points[near])).float()).numpy() * scenes.SCALE
    off = found - truth[near]
    assert abs(np.median(off)) < VOXEL
    assert np.quantile(np.abs(off), 0.8) < 1.5 * VOXEL
    free = points[truth > 0.1]
    assert (run.field.signed_distance(torch.from_numpy(into_dataset(free)).float()) > 0).all()


def test_the_thing_is_registered_in_it(run: Imported) -> None:
    """The model has the dataset's unit; the pose is right within 2 % of its size."""
    solid = trimesh.util.concatenate([trimesh.creation.box(bounds=np.array(box)) for box in scenes.STAIR])
    solid.apply_scale(1.0 / scenes.SCALE)
    corners = np.array(trimesh.bounds.corners(np.array([[-0.3, -0.2, 0.0], [0.3, 0.2, 0.4]])))
    seen = into_dataset(corners @ scenes.TURN.T + scenes.PLACE)
    low, high = seen.min(axis=0), seen.max(axis=0)
    box = OrientedBox(torch.tensor((low + high) / 2), torch.tensor(high - low), torch.eye(3, dtype=torch.float64))
    found = register(run.field, field_of(converted(solid, **{"as": "object"})), box, seed=0, clouds=False)
    assert found.verdict == "registered"
    assert found.T_object_scene is not None
    reached = found.T_object_scene.apply(torch.from_numpy(seen)).numpy()
    size = np.linalg.norm(corners[0] - corners[6]) / scenes.SCALE
    assert np.linalg.norm(reached - corners / scenes.SCALE, axis=1).max() < 0.02 * size


def test_the_confined_process_sees_by_given_cameras_in_the_trainers_frame(tmp_path: Path) -> None:
    """tiny-cuda-nn's one vector, without settings: what is assumed is said."""
    upload = scenes.checkpoint(tmp_path / "upload", scenes.state_of(scenes.nerfacto(tiny=True)))
    cameras = tmp_path / "transforms.json"
    cameras.write_text(json.dumps(scenes.transforms(scenes.cameras(4))))
    said = BASE | {"bounds": [[-0.6, -0.6, -0.4], [0.7, 0.6, 0.3]]}
    report = import_field(upload, tmp_path / "out", said, cameras=cameras)
    assert report.family == "nerfstudio_nerfacto"
    assert any("average_init_density is 0.01" in warning for warning in report.warnings)
    assert not any(warning.startswith("CAMERAS_NOT_USED") for warning in report.warnings)
    field = open_field(tmp_path / "out" / FIELD_NAME)
    assert isinstance(field, ObservedField)
    floor = torch.cartesian_prod(torch.linspace(-0.5, 0.6, 12), torch.tensor([-0.5, -0.45, 0.45, 0.5]))
    above = torch.cat([floor, torch.full((len(floor), 1), scenes.FLOOR + 0.01)], dim=1)
    assert float(field.signed_distance(above).median()) == pytest.approx(0.01, abs=0.008)
    hidden = torch.tensor([[0.5, 0.5, -0.38], [*scenes.PLACE[:2], scenes.FLOOR + 0.04]])
    assert field.observation.at(hidden).tolist() == [0, 0]
    above[:, 2] = scenes.FLOOR + 0.04
    assert float(field.observation.at(above).float().median()) == 1.0


def radiance_of(path: Path, said: dict[str, Any] | None = None) -> Radiance | None:
    archive = read_archive(memoryview(path.read_bytes()))
    source = TensorSource(archive, 1 << 30)
    return read_radiance(read_pickle(archive.read("data.pkl")), source, UploadDescription.from_dict(said))


def test_a_file_of_the_trainers_own_code_has_its_densities() -> None:
    """data/: NerfactoField of nerfstudio 1.1.5 in plain PyTorch, five levels up to 100 nodes, random tensors, saved by
    torch.save; and what its density_fn gives, within and beyond the part of space that is contracted."""
    found = radiance_of(DATA / "nerfacto.ckpt")
    assert found is not None
    assert "5 levels of 2, 16 to 100 nodes, 2 layers" in found.why
    with np.load(DATA / "nerfacto.npz") as told:
        np.testing.assert_allclose(np.log(found.field.density(told["points"])), np.log(told["density"]), atol=1e-4)


@pytest.mark.parametrize("names", ["model", "sequence", "params"])
@pytest.mark.parametrize("tiny", [True, False])
@pytest.mark.parametrize("prefix", ["_model.field.", "_model.module.field."])
def test_names_of_all_releases_have_one_density(names: str, tiny: bool, prefix: str, tmp_path: Path) -> None:
    """Releases without the factor of the density have 1."""
    if names == "params" and not tiny:
        return
    field = scenes.nerfacto(tiny)
    found = radiance_of(scenes.checkpoint(tmp_path / "a", scenes.state_of(field, names), prefix), BASE)
    assert found is not None
    points = np.random.default_rng(2).uniform(-3.0, 3.0, (500, 3))
    factor = 0.01 if names == "model" else 1.0
    wanted = np.log(factor) + field.exponent((scenes.contracted(points) + 2.0) / 4.0)
    np.testing.assert_allclose(np.log(found.field.density(points)), wanted, atol=2e-3)


def test_half_precision_and_the_box_of_a_scene_that_is_not_contracted(tmp_path: Path) -> None:
    field = scenes.nerfacto(True, is_contracted=False)
    state = scenes.state_of(field)
    state["mlp_base.model.params"] = state["mlp_base.model.params"].half()
    found = radiance_of(scenes.checkpoint(tmp_path / "a", state), BASE | {"contraction": "none", "output_scale": 0.3})
    assert found is not None
    assert not found.warnings
    points = np.random.default_rng(2).uniform(-1.4, 1.4, (500, 3))
    wanted = np.log(0.3) + field.exponent((points + 1.5) / 3.0)
    np.testing.assert_allclose(np.log(found.field.density(points)), wanted, atol=0.05)
    assert (found.field.density(points + 3.0) == 0.0).all()


def refusal(path: Path, said: dict[str, Any] | None = None, cameras: Path | None = None) -> FieldFormatError:
    beside = Companions(cameras=None if cameras is None else (cameras.name, cameras))
    with pytest.raises(FieldFormatError) as caught:
        convert_file(path, path.parent, said, ImportLimits(), beside=beside)
    return caught.value


def test_without_cameras_the_refusal_says_what_to_give(tmp_path: Path) -> None:
    error = refusal(scenes.checkpoint(tmp_path / "a", scenes.state_of(scenes.nerfacto(True))), BASE)
    assert error.reason == "CAMERAS_NOT_RECOGNIZED"
    for words in ("transforms.json", "dataparser_transforms.json", "regnf fuse", "ns-export"):
        assert words in str(error)


def test_cameras_of_another_frame_are_refused(tmp_path: Path) -> None:
    upload = scenes.checkpoint(tmp_path / "a", scenes.state_of(scenes.nerfacto(True)))
    under = [looking(np.array([x, 0.3, -0.8]), np.array([x, 0.0, -0.8])) for x in np.linspace(-0.5, 0.5, 6)]
    (tmp_path / "transforms.json").write_text(json.dumps(scenes.transforms(under)))
    error = refusal(upload, BASE, tmp_path / "transforms.json")
    assert error.reason == "CAMERAS_OF_ANOTHER_FRAME"
    assert "6 of 6 cameras are inside matter" in str(error)


def test_faint_fog_has_no_surface(tmp_path: Path) -> None:
    state = scenes.state_of(scenes.nerfacto(False))
    state["mlp_base.model.1.layers.1.bias"] -= 40.0
    upload = scenes.checkpoint(tmp_path / "a", state)
    (tmp_path / "transforms.json").write_text(json.dumps(scenes.transforms(scenes.cameras(4))))
    error = refusal(upload, BASE, tmp_path / "transforms.json")
    assert error.reason == "NO_ZERO_LEVEL"


def test_a_network_that_would_take_hours_is_refused(tmp_path: Path) -> None:
    """1024 neurons in each of six layers: about 2^24 places times 4 million weights."""
    state = scenes.state_of(scenes.nerfacto(False))
    layers = "mlp_base.model.1.layers."
    shapes = [(1024, 16), *[(1024, 1024)] * 4, (16, 1024)]
    for number, shape in enumerate(shapes):
        state |= {f"{layers}{number}.weight": torch.zeros(shape), f"{layers}{number}.bias": torch.zeros(shape[0])}
    upload = scenes.checkpoint(tmp_path / "a", state)
    (tmp_path / "transforms.json").write_text(json.dumps(scenes.transforms(scenes.cameras(2))))
    beside = Companions(cameras=("transforms.json", tmp_path / "transforms.json"))
    with pytest.raises(FieldFormatError) as caught:
        convert_file(upload, tmp_path, BASE, ImportLimits(wall_s=120.0), beside=beside)
    assert caught.value.reason == "IMPORT_TOO_COSTLY"


def test_layouts_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    tiny, plain = (scenes.state_of(scenes.nerfacto(is_tiny)) for is_tiny in (True, False))
    rows = {**plain, "num_levels": torch.tensor(7)}
    width = {**plain, "mlp_base.model.1.layers.0.weight": torch.zeros(64, 14)}
    for state, said, reason in (
        (tiny, None, "HASH_GRID_NOT_RECOGNIZED"),
        (tiny, {"hash": {"base_resolution": 9}}, "HASH_GRID_NOT_RECOGNIZED"),
        (tiny, {"hash": {"base_resolution": 8, "levels": 9}}, "SETTINGS_CONTRADICT_TENSORS"),
        (tiny, {"hash": {"base_resolution": 8, "interpolation": "smoothstep"}}, "INVALID_DESCRIPTION"),
        (tiny, BASE | {"truncation": 0.1}, "INVALID_DESCRIPTION"),
        (tiny, BASE | {"family": "neus"}, "FAMILY_NOT_SUPPORTED"),
        ({**tiny, "num_levels": torch.tensor(5)}, BASE, "FAMILY_NOT_SUPPORTED"),
        ({**tiny, "max_res": torch.tensor(4)}, BASE, "SETTINGS_CONTRADICT_TENSORS"),
        ({**tiny, "max_res": torch.tensor(0)}, BASE, "HASH_GRID_NOT_RECOGNIZED"),
        (rows, BASE, "SETTINGS_CONTRADICT_TENSORS"),
        (width, BASE, "SETTINGS_CONTRADICT_TENSORS"),
        ({**plain, "aabb": torch.zeros(2, 3)}, BASE | {"contraction": "none"}, "BOUNDS_INVALID"),
    ):
        with pytest.raises(FieldFormatError) as caught:
            radiance_of(scenes.checkpoint(tmp_path / "a", state), said)
        assert caught.value.reason == reason, (said, str(caught.value))


def test_settings_that_contradict_the_checkpoint_are_refused(tmp_path: Path) -> None:
    upload = scenes.checkpoint(tmp_path / "step-000000001.ckpt", scenes.state_of(scenes.nerfacto(True)))
    with zipfile.ZipFile(tmp_path / "run.zip", "w") as archive:
        archive.write(upload, "run/step-000000001.ckpt")
        archive.writestr("run/config.yml", scenes.config(max_res=2048))
    error = refusal(tmp_path / "run.zip")
    assert error.reason == "SETTINGS_CONTRADICT_TENSORS"
    assert "max_res" in str(error)


def test_generfacto_has_its_names_but_another_density(tmp_path: Path) -> None:
    state = scenes.state_of(scenes.nerfacto(True), "sequence") | {"mlp_background_color.layers.0.weight": torch.ones(4)}
    error = refusal(scenes.checkpoint(tmp_path / "a", state), BASE)
    assert error.reason == "FAMILY_NOT_SUPPORTED"
    assert "generfacto" in str(error)
