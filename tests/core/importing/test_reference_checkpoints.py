"""Checkpoints made by the families' own trainers, against values computed by the families' own code."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.fields.observation import has_color
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.archives import assert_refused
from tests.devdata import dev_data

CHECKPOINTS = {".ckpt", ".pth", ".pt"}
SAID: dict[str, Any] = {
    "hash": {"levels": 16, "base_resolution": 16, "top_resolution": 2048, "interpolation": "smoothstep"},
    "use_grid": True,
    "positional_encoding": {"degree": 6},
}
"""What both studios' configurations say of the layout: nothing is tried."""
ANGELO_GRID = {"hash": {"base_resolution": 16, "top_resolution": 512, "features_per_level": 8}}
COLORS = {
    "sdfstudio_neus_facto": "rgb_uncontracted.npy",
    "sdfstudio_neus": "rgb_uncontracted.npy",
    "sdfstudio_neus_facto_angelo": "rgb_uncontracted_autograd_gradient.npy",
    "nerfstudio_neus_facto": "rgb.npy",
    "neus": "rgb.npy",
    "instant_nsr_pl": "rgb.npy",
}
"""The values of the colors, of points that are not contracted. angelo's own gradient is of differences, with noise."""
WARNED = {family: ["COLOR_ASSUMED"] for family in COLORS.keys() - {"neus", "instant_nsr_pl"}}
WARNED |= {"instant_nsr_pl": ["ACTIVATION_ASSUMED"], "neuralangelo": ["COLOR_LEFT_OUT"]}
"""Their appearance is not in the file alone, and neuralangelo's color is not read."""
_opened: list[str] = []
_watching = False


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if _watching and event == "open":
        _opened.append(str(arguments[0]))


def only_file(folder: Path, suffixes: set[str]) -> Path:
    (path,) = [path for path in folder.rglob("*") if path.suffix in suffixes]
    return path


def assert_reproduces(field_file: Path, folder: Path) -> None:
    """Distances within 1e-5 of their range, gradients within 1e-3."""
    points = torch.from_numpy(np.load(folder / "points.npy"))
    distance, gradient = open_field(field_file).signed_distance_and_gradient(points)
    expected = np.load(folder / "sdf.npy").reshape(-1)
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-5 * np.ptp(expected))
    np.testing.assert_allclose(gradient.numpy(), np.load(folder / "gradient.npy"), rtol=0, atol=1e-3)


def assert_reproduces_color(field_file: Path, folder: Path, values: str) -> None:
    """Colors within 5e-6 of those in the file ``values``, clamped as a color is; the inverse deviation to 1e-6."""
    field = open_field(field_file)
    assert has_color(field)
    points, directions = (torch.from_numpy(np.load(folder / f"{name}.npy")) for name in ("points", "directions"))
    expected = np.load(folder / values).clip(0.0, 1.0)
    if folder.name == "neus":  # its trainer's images are B, G, R
        expected = expected[:, ::-1]
    np.testing.assert_allclose(field.color(points, directions).numpy(), expected, rtol=0, atol=5e-6)
    assert field.inverse_deviation == pytest.approx(float(np.load(folder / "inv_s.npy")[0]), rel=1e-6)


@pytest.mark.parametrize(
    ("family", "description"),
    [
        ("sdfstudio_neus_facto", None),
        ("nerfstudio_neus_facto", None),
        ("sdfstudio_neus", None),
        ("sdfstudio_neus_facto_angelo", None),
        ("sdfstudio_neus_facto_angelo", ANGELO_GRID),
        ("neus", {"input_scale": 1.0}),
        ("siren", None),
        ("instant_nsr_pl", None),
        ("neuralangelo", None),
    ],
)
def test_every_variant_is_recognized_and_reproduced(
    tmp_path: Path, family: str, description: dict[str, Any] | None
) -> None:
    folder = dev_data("formats", family)
    report = convert_file(only_file(folder, CHECKPOINTS), tmp_path, description, ImportLimits())
    assert report["family"] == family
    assert [warning.partition(":")[0] for warning in report["warnings"]] == WARNED.get(family, [])
    assert report["plausibility"]["gradient_median"] == pytest.approx(1.0, abs=0.02)
    assert_reproduces(tmp_path / FIELD_NAME, folder)
    if family in COLORS:
        assert_reproduces_color(tmp_path / FIELD_NAME, folder, COLORS[family])


@pytest.mark.parametrize("family", ["sdfstudio_neus_facto", "nerfstudio_neus_facto"])
def test_the_mean_appearance_may_be_asked_for(tmp_path: Path, family: str) -> None:
    folder = dev_data("formats", family)
    contracted = {"contraction": "linf"} if family.startswith("sdf") else {}
    said = SAID | contracted | {"color": {"average_appearance": True}}
    convert_file(only_file(folder, {".ckpt"}), tmp_path, said, ImportLimits())
    assert_reproduces_color(tmp_path / FIELD_NAME, folder, "rgb_average_appearance.npy")


def test_the_contraction_may_be_asked_for(tmp_path: Path) -> None:
    folder = dev_data("formats", "sdfstudio_neus_facto")
    convert_file(only_file(folder, {".ckpt"}), tmp_path, SAID | {"contraction": "linf"}, ImportLimits())
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(torch.from_numpy(np.load(folder / "points.npy")))
    expected = np.load(folder / "sdf_contracted.npy").reshape(-1)
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-5 * np.ptp(expected))
    assert_reproduces_color(tmp_path / FIELD_NAME, folder, "rgb.npy")


def test_the_trainers_configuration_is_never_opened(tmp_path: Path) -> None:
    """Its YAML holds object tags that run code in an unsafe loader."""
    global _watching
    checkpoint = only_file(dev_data("formats", "sdfstudio_neus_facto"), {".ckpt"})
    sys.addaudithook(_audit)
    _watching = True
    try:
        convert_file(checkpoint, tmp_path, SAID, ImportLimits())
    finally:
        _watching = False
    assert str(checkpoint) in _opened
    assert not [name for name in _opened if name.endswith((".yml", ".yaml"))]


def deepsdf_run() -> tuple[Path, dict[str, Path]]:
    """The reference folder, and the files of its training run: the network, all codes, the code of one shape."""
    folder = dev_data("formats", "deepsdf")
    run = folder / "examples" / "toys"
    return folder, {
        "network": run / "ModelParameters" / "latest.pth",
        "codes": run / "LatentCodes" / "latest.pth",
        "code": run / "Reconstructions" / "2000" / "Codes" / "toys" / "solid" / "part_1.pth",
    }


def test_deepsdf_s_network_with_a_code_from_the_description(tmp_path: Path) -> None:
    """The trainer's own file, in the container of before 1.6."""
    folder, files = deepsdf_run()
    latent = np.load(folder / "latent.npy").ravel().tolist()
    report = convert_file(files["network"], tmp_path, {"latent": latent, "output_tanh": 1}, ImportLimits())
    assert report["family"] == "deepsdf"
    assert report["warnings"] == []
    assert_reproduces(tmp_path / FIELD_NAME, folder)


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize(("codes", "index"), [("codes", 1), ("code", 0)])
def test_deepsdf_s_network_and_codes_in_one_file(tmp_path: Path, codes: str, index: int, zipped: bool) -> None:
    """Put together as docs/formats.md says."""
    folder, files = deepsdf_run()
    whole = torch.load(files["network"], map_location="cpu", weights_only=True)
    stored = torch.load(files[codes], map_location="cpu", weights_only=True)
    whole["latent_codes"] = stored["latent_codes"] if isinstance(stored, dict) else stored
    torch.save(whole, tmp_path / "upload.pth", _use_new_zipfile_serialization=zipped)
    convert_file(tmp_path / "upload.pth", tmp_path, {"latent_index": index, "output_tanh": 1}, ImportLimits())
    assert_reproduces(tmp_path / FIELD_NAME, folder)


@pytest.mark.parametrize(("file", "reason"), [("network", "LATENT_MISSING"), ("codes", "FIELD_NOT_RECOGNIZED")])
def test_half_of_deepsdf_is_refused(tmp_path: Path, file: str, reason: str) -> None:
    assert_refused(lambda: convert_file(deepsdf_run()[1][file], tmp_path, None, ImportLimits()), reason)
