"""Which file of a run is its checkpoint, and which are its settings, by names alone."""

from __future__ import annotations

import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.run.opened import choose_checkpoint, choose_settings
from tests.core.importing.archives import assert_refused


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (["r/sdfstudio_models/step-000009999.ckpt", "r/sdfstudio_models/step-000030000.ckpt"], 1),
        (["c/ckpt_050000.pth", "c/ckpt_300000.pth", "c/ckpt_100000.pth"], 1),
        (["ckpt/epoch=0-step=9000.ckpt", "ckpt/epoch=0-step=20000.ckpt"], 1),
        (["ckpt/epoch=2-step=9000.ckpt", "ckpt/last.ckpt"], 1),
        (["g/epoch_00001_iteration_000000500_checkpoint.pt", "g/epoch_00002_iteration_000001000_checkpoint.pt"], 1),
        (["ModelParameters/2000.pth", "ModelParameters/latest.pth", "OptimizerParameters/latest.pth"], 1),
        (["checkpoints/ModelParameters/500.pth", "checkpoints/SchedulerParameters/500.pth"], 0),
        (["checkpoints/model_epoch_0100.pth", "checkpoints/model_current.pth", "checkpoints/model_final.pth"], 2),
        (["checkpoints/ngp_ep0009.pth.tar", "checkpoints/ngp_ep0010.pth.tar", "checkpoints/ngp.pth.tar"], 1),
        *((["checkpoints/step_90.pth", "checkpoints/step_100.pth"], 1), (["best_model.pth", "model_100.pth"], 1)),
        *((["model/pin_map.pth", "mesh/mesh.ply", "map/neural_points.ply"], 0), (["a.onnx", "a.ply"], 0)),
        *((["scene.gltf", "scene.bin"], 0), (["cameras_sphere.npz", "checkpoints/ckpt_10.pth"], 1)),
        (["._a.pth", "__MACOSX/a.pth", "a.pth"], 2),
    ],
)
def test_the_newest_checkpoint_of_a_run(names: list[str], chosen: int) -> None:
    assert choose_checkpoint(names) == names[chosen]
    assert choose_checkpoint(names[::-1]) == names[chosen]


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        ([], "RUN_WITHOUT_CHECKPOINT"),
        (["config.yml", "OptimizerParameters/latest.pth", "optimizer.pth", ".pth"], "RUN_WITHOUT_CHECKPOINT"),
        (["a/step-1.ckpt", "b/step-2.ckpt"], "AMBIGUOUS_RUN"),
        (["chair.pth", "table.pth"], "AMBIGUOUS_RUN"),
        (["scan_1.ply", "scan_2.ply"], "AMBIGUOUS_RUN"),
        (["model.pth", "model.ckpt"], "AMBIGUOUS_RUN"),
    ],
)
def test_runs_without_one_checkpoint(names: list[str], reason: str) -> None:
    assert_refused(lambda: choose_checkpoint(names), reason)


def test_the_nearest_settings_belong_to_the_checkpoint() -> None:
    names = [
        *("out/config.yml", "out/a/config.yml", "out/a/dataparser_transforms.json", "out/b/config.yml"),
        *("data/meta_data.json", "out/a/notes.yml"),
    ]
    chosen = choose_settings(names, "out/a/nerfstudio_models/step-1.ckpt")
    assert set(chosen) == {"out/a/config.yml", "out/a/dataparser_transforms.json", "data/meta_data.json"}


def test_codes_of_the_same_epoch_are_chosen() -> None:
    names = ["specs.json", "LatentCodes/100.pth", "LatentCodes/latest.pth", "d/NormalizationParameters/a/b.npz"]
    assert set(choose_settings(names, "ModelParameters/100.pth")) == {names[0], names[1], names[3]}


def test_data_of_several_scenes_is_nobody_s() -> None:
    names = ["data/a/transforms.json", "data/b/transforms.json"]
    assert choose_settings(names, "logs/x/epoch_1_iteration_2_checkpoint.pt") == ()


def test_files_to_choose_from_are_named_whole() -> None:
    names = [f"{'run ' * 20}/{part * 12}/{part}.safetensors" for part in ("coarse", "fine")]
    with pytest.raises(FieldFormatError) as refused:
        choose_checkpoint(names)
    assert all(f" {name}" in str(refused.value) for name in names)
    with pytest.raises(FieldFormatError, match=r": \.\.\.a"):
        choose_checkpoint([f"{'a' * 300}/{part}.safetensors" for part in ("coarse", "fine")])
