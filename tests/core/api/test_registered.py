"""What users call: fields by paths, boxes of others, options as dictionaries; results that print, draw and save."""

from __future__ import annotations

import copy
import dataclasses
import io
import json
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
import torch
import trimesh

import regnf
from regnf_core.errors import InvalidOptionsError
from regnf_core.viewing import registration_picture
from tests.cli.conftest import DATA

BOX = json.loads((DATA / "detection.json").read_text())
ROOM, CHAIR = DATA / "mix-room.safetensors", DATA / "armchair.safetensors"


@pytest.fixture(scope="module")
def found() -> regnf.Registered:
    return regnf.register(ROOM, str(CHAIR), BOX, {"up_axis": "z"}, seed=3)


@pytest.mark.parametrize("seed", ["7", 1.5, -1, 2**32, True, None])
def test_a_seed_is_a_whole_number_everywhere(seed: Any, tmp_path: Path) -> None:
    calls: list[Callable[[], object]] = [
        lambda: regnf.register(ROOM, CHAIR, BOX, seed=seed),
        lambda: regnf.register_batch(ROOM, [BOX], [CHAIR], seed=seed),
        lambda: regnf.search(ROOM, [CHAIR], BOX, seed=seed),
        lambda: regnf.compose(ROOM, [], seed=seed),
        lambda: regnf.fit(tmp_path / "none.ply", tmp_path / "a.safetensors", seed=seed),
    ]
    for call in calls:
        with pytest.raises(InvalidOptionsError, match="the seed is"):
            call()


@pytest.mark.parametrize("device", ["gpu", "cuda:99", "", 3.5])
def test_a_device_that_is_not_there_is_refused(device: Any) -> None:
    for field in (CHAIR, trimesh.creation.box()):
        with pytest.raises(InvalidOptionsError, match="cannot use the device"):
            regnf.open_field(field, device=device)


@pytest.mark.parametrize(
    ("source", "description", "reason", "says"),
    [
        (CHAIR, "z up", "INVALID_DESCRIPTION", "the description is a str"),
        ("https://example.org/chair.glb", None, "FILE_NOT_FOUND", "Download the file"),
    ],
)
def test_what_is_no_description_or_no_file(source: Any, description: Any, reason: str, says: str) -> None:
    with pytest.raises(regnf.RegnfError) as refused:
        regnf.open_field(source, description=description)
    assert refused.value.reason == reason
    assert says in f"{refused.value} {refused.value.hint}"


def test_a_result_says_what_it_is(found: regnf.Registered) -> None:
    assert isinstance(found, regnf.RegistrationResult)
    assert isinstance(found.scale, float)
    assert found.scale == pytest.approx(1.25, rel=0.01)
    pose, back = np.asarray(found.T_scene_object), np.asarray(found.T_object_scene)
    np.testing.assert_allclose(pose @ back, np.eye(4), atol=1e-12)
    center = pose[:3, :3] @ found.center_object.numpy() + pose[:3, 3]
    np.testing.assert_allclose(found.center_scene.numpy(), center, atol=1e-12)
    assert found.uncertainty is not None
    assert found.uncertainty == found.to_dict()["uncertainty"]
    assert max(found.uncertainty["center_scene"]) < 0.005
    assert repr(found).startswith("<registered: SURFACES_AGREE, scale 1.2")
    assert len(repr(found)) < 100


def test_paths_and_open_fields_are_the_same(found: regnf.Registered) -> None:
    box = regnf.OrientedBox.from_dict(BOX)
    options = regnf.RegistrationOptions(up_axis="z")
    again = regnf.register(regnf.open_field(ROOM), regnf.open_field(CHAIR), box, options, seed=3)
    assert np.array_equal(again.T_scene_object, found.T_scene_object)
    assert (found.object_name, again.object_name) == (str(CHAIR), None)


def test_save_writes_what_the_command_writes(found: regnf.Registered, tmp_path: Path) -> None:
    paths = found.save(tmp_path / "out")
    names = {path.name for path in paths}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    assert {"result.json", "preview.png", "aligned.ply", "T_scene_object.npy", "trace.json"} <= names
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["object"] == str(CHAIR)
    assert set(document["fields"]) == {"scene", "object"}
    assert document == json.loads(json.dumps(found.to_dict()))
    (tmp_path / "file").write_text("")
    with pytest.raises(regnf.RegnfError, match="expected a folder"):
        found.save(tmp_path / "file")


def test_plot_draws(found: regnf.Registered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr("regnf_core.api.show", shown.append)
    picture = found.plot(tmp_path / "chair.png")
    assert picture.size[0] > 1000
    assert (tmp_path / "chair.png").read_bytes().startswith(b"\x89PNG")
    assert shown == []
    found.plot()
    assert shown == [found]


def test_a_window_needs_a_display(found: regnf.Registered, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert registration_picture.show(found) is False
    drawn: list[tuple[str, int]] = []
    monkeypatch.setattr(registration_picture, "has_display", lambda: True)
    monkeypatch.setattr("regnf_core.viewing.registration_picture.importlib.import_module", lambda name: name)
    monkeypatch.setattr(
        registration_picture, "_with_pyvista", lambda library, clouds: drawn.append((library, len(clouds)))
    )
    assert registration_picture.show(found) is True
    assert drawn == [("pyvista", 2)]


def test_notebooks_show_picture_and_verdict(found: regnf.Registered) -> None:
    html = found._repr_html_()
    assert "<b>registered</b>" in html
    assert "data:image/png;base64," in html
    png = found._repr_png_()
    assert png is not None
    assert png.startswith(b"\x89PNG")


def test_a_batch_and_a_search() -> None:
    box = regnf.OrientedBox.from_dict(BOX)
    scene, thing = regnf.open_field(ROOM), regnf.open_field(CHAIR)
    (outcome,) = regnf.register_batch(scene, [BOX], [CHAIR], options={"up_axis": "z"}, clouds=False)
    assert outcome.result is not None
    assert (outcome.result.verdict, outcome.result.object_name) == ("registered", str(CHAIR))
    ranked = regnf.search(scene, {"a chair": thing, "the room": scene}, box, {"up_axis": "z"})
    assert ranked.ranking[0].name == ranked.result.object_name == "a chair"
    assert "a chair" in repr(ranked)


def test_boxes_that_people_have() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    center, size = [1.0, 2.0, 3.0], np.array([2.0, 4.0, 6.0])
    first = regnf.OrientedBox.from_center([1, 2, 3], size, turn, label="chair")
    second = regnf.OrientedBox.from_open3d(open3d.geometry.OrientedBoundingBox(center, turn, size), "chair")
    for one in (first, second):
        assert np.allclose(one.rotation, turn)
        assert repr(one) == "OrientedBox(center [1.0, 2.0, 3.0], size [2.0, 4.0, 6.0], turned, 'chair')"
    third = regnf.OrientedBox.from_open3d(open3d.geometry.AxisAlignedBoundingBox([0, 0, 0], size))
    fourth = regnf.OrientedBox.from_corners(np.zeros(3), size)
    assert repr(third) == repr(fourth) == "OrientedBox(center [1.0, 2.0, 3.0], size [2.0, 4.0, 6.0])"


def test_short_words_for_transforms_and_fields() -> None:
    assert repr(regnf.Sim3.identity()) == "Sim3(scale 1, quaternion xyzw [0, 0, 0, 1], translation [0, 0, 0])"
    assert repr(regnf.Sim3.identity()[None]) == "Sim3(1 transforms)"
    assert len(repr(regnf.open_field(CHAIR))) < 150
    assert "bounds" in repr(regnf.open_field(CHAIR))


def members(value: Any, place: str = "result") -> Iterator[tuple[str, Any]]:
    """All that can be reached from a value by public attributes, entries and items."""
    yield place, value
    parts: list[tuple[str, Any]] = []
    if dataclasses.is_dataclass(value):
        names = [name for name in dir(value) if not name.startswith("_")]
        parts = [(f".{name}", getattr(value, name)) for name in names if not callable(getattr(value, name))]
    elif isinstance(value, dict):
        parts = [(f"[{name!r}]", one) for name, one in value.items()]
    elif isinstance(value, list | tuple):
        parts = [("[0]", one) for one in value[:1]]
    for name, one in parts:
        yield from members(one, place + name)


@pytest.mark.filterwarnings("error")
def test_numpy_takes_every_member_of_a_result(found: regnf.Registered) -> None:
    arrays = {place: one for place, one in members(found) if hasattr(one, "__array__")}
    assert {"result.covariance", "result.detection.center", "result.residuals['scene_points']"} <= arrays.keys()
    assert {"result.T_scene_object.rotation", "result.trace[0].T_object_scene.scale"} <= arrays.keys()
    arrays["matrix"] = found.T_scene_object.matrix()
    arrays["inverse"] = found.T_scene_object.inverse().translation
    for place, one in arrays.items():
        assert np.array_equal(np.array(one), np.asarray(one)), place
        assert np.array(one, copy=True).base is None or np.array(one).flags.owndata, place
        assert np.array(one, dtype="f4").dtype == np.float32, place
        if isinstance(one, torch.Tensor):
            assert np.shares_memory(np.array(one, copy=False), np.asarray(one)), place


@pytest.mark.filterwarnings("error")
def test_results_can_be_copied_stored_and_put_into_json(found: regnf.Registered) -> None:
    stream = io.BytesIO()
    torch.save(found, stream)
    stream.seek(0)
    copies = (copy.deepcopy(found), pickle.loads(pickle.dumps(found)), torch.load(stream, weights_only=False))
    for again in (*copies, dataclasses.replace(found, seed=1), copy.copy(found)):
        assert torch.equal(again.covariance, found.covariance)
        assert np.array_equal(np.array(again.covariance), np.array(found.covariance))
        assert torch.equal(again.T_scene_object.matrix(), found.T_scene_object.matrix())
    assert found != copies[0]
    assert len({found, found, copies[0]}) == 2
    for plain in (found.metrics, found.options, found.uncertainty, found.to_dict(), found.probability, found.scale):
        assert json.loads(json.dumps(plain)) == plain
    assert float(found.T_object_scene.scale) == found.scale
