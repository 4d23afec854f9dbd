"""glTF with compressed meshes: against DracoPy's and meshoptimizer's own encoders, and quantized numbers by hand."""

from __future__ import annotations

import base64
import json
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes import meshopt, read_mesh
from tests.core.importing.archives import assert_refused
from tests.core.importing.meshes.mesh_files import BALL
from tests.core.importing.meshes.test_bad_meshes import glb

# Written by meshoptimizer itself: scripts/make_cad_files.py.
CASES = json.loads((Path(__file__).parent / "data" / "meshopt.json").read_text())
TYPES = {("OCTAHEDRAL", 4): "i1", ("OCTAHEDRAL", 8): "<i2", ("QUATERNION", 8): "<i2", ("EXPONENTIAL", 12): "<f4"}
ACCESSORS: list[dict[str, Any]] = [
    {"componentType": 5126, "count": len(BALL.vertices), "type": "VEC3"},
    {"componentType": 5125, "count": BALL.faces.size, "type": "SCALAR"},
]
PRIMITIVE: dict[str, Any] = {"attributes": {"POSITION": 0}, "indices": 1}


@pytest.mark.parametrize("number", range(len(CASES)))
def test_meshopt_gives_what_its_own_decoder_gives(number: int) -> None:
    mode, filter_, count, stride, packed, expected = CASES[number]
    found = bytes(meshopt.decoded(memoryview(base64.b64decode(packed)), count, stride, mode, filter_))
    if filter_ in ("NONE", "EXPONENTIAL"):
        assert found == base64.b64decode(expected)
    else:  # its own rounds in single precision
        numbers = [np.frombuffer(data, TYPES[filter_, stride]) for data in (found, base64.b64decode(expected))]
        np.testing.assert_allclose(*(one.astype(int) for one in numbers), atol=1)


def test_damaged_meshopt_data_is_refused() -> None:
    generator = np.random.default_rng(0)
    for mode, filter_, count, stride, packed, _ in CASES:
        data = base64.b64decode(packed)
        for cut in (0, 1, len(data) // 2, len(data) - 1):
            with pytest.raises(FieldFormatError):
                meshopt.decoded(memoryview(data[:cut]), count, stride, mode, filter_)
        for _ in range(20):
            broken = bytearray(data)
            broken[generator.integers(len(data))] = generator.integers(256)
            with suppress(FieldFormatError):  # and nothing else
                meshopt.decoded(memoryview(bytes(broken)), count, stride, mode, filter_)
    later = memoryview(b"\xa1" + bytes(64))
    assert_refused(lambda: meshopt.decoded(later, 3, 12, "ATTRIBUTES", "NONE"), "FORMAT_NOT_SUPPORTED")
    assert_refused(lambda: meshopt.decoded(later, 3, 12, "ATTRIBUTES", "COLOR"), "FORMAT_NOT_SUPPORTED")
    assert_refused(lambda: meshopt.decoded(later, 3, 12, "POINTS", "NONE"), "MESH_INVALID")


def test_a_meshopt_view_is_read_in_place_of_its_fallback() -> None:
    mode, _, count, stride, packed, expected = next(case for case in CASES if case[0] == "TRIANGLES")
    places = np.random.default_rng(0).normal(size=(count, 3)).astype("<f4")
    data = base64.b64decode(packed)
    codec = {"buffer": 0, "byteOffset": places.nbytes, "byteLength": len(data), "byteStride": stride, "count": count}
    extension = {"EXT_meshopt_compression": {**codec, "mode": mode}}
    view = {"buffer": 1, "byteLength": count * stride, "extensions": extension}
    accessors = [{**ACCESSORS[0], "count": count, "bufferView": 0}, {**ACCESSORS[1], "count": count, "bufferView": 1}]
    fallback = {"byteLength": count * stride, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [PRIMITIVE]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": places.nbytes}, view],
        "buffers": [{"byteLength": places.nbytes + len(data)}, fallback],
        "extensionsRequired": ["EXT_meshopt_compression"],
    }
    found = read_mesh("glb", memoryview(glb(document, places.tobytes() + data)))
    np.testing.assert_array_equal(found.faces.reshape(-1), np.frombuffer(base64.b64decode(expected), "<u4"))
    assert found.not_applied == ()


def draco_ball(**changes: Any) -> bytes:
    packed = DracoPy.encode(BALL.vertices, BALL.faces, quantization_bits=16)
    said = {"bufferView": 0, "attributes": {"POSITION": 0}}
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}],
        "scenes": [{"nodes": [0, 1]}],
        "meshes": [{"primitives": [PRIMITIVE | {"extensions": {"KHR_draco_mesh_compression": said}}]}],
        "accessors": ACCESSORS,
        "bufferViews": [{"buffer": 0, "byteLength": len(packed)}],
        "buffers": [{"byteLength": len(packed)}],
        "extensionsUsed": ["KHR_draco_mesh_compression"],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
    }
    return glb(document | changes, packed)


def test_draco_is_read_at_every_node() -> None:
    found = read_mesh("glb", memoryview(draco_ball()))
    assert len(found.faces) == 2 * len(BALL.faces)
    assert found.not_applied == ()
    corners = found.vertices[found.faces[: len(BALL.faces)]]
    order = np.lexsort(np.round(corners.mean(axis=1), 4).T)
    given = BALL.vertices[BALL.faces]
    expected = given[np.lexsort(np.round(given.mean(axis=1), 4).T)]
    np.testing.assert_allclose(corners[order].mean(axis=1), expected.mean(axis=1), atol=1e-4)
    np.testing.assert_allclose(found.vertices[len(found.vertices) // 2 :].mean(axis=0), [3, 0, 0], atol=1e-4)


def test_draco_that_contradicts_its_accessors_is_refused() -> None:
    for at, count in ((0, 161), (1, 957)):
        changed = [dict(one) for one in ACCESSORS]
        changed[at]["count"] = count
        data = memoryview(draco_ball(accessors=changed))
        assert_refused(partial(read_mesh, "glb", data), "MESH_INVALID")


def test_without_its_library_draco_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(FieldFormatError) as caught:
        read_mesh("glb", memoryview(draco_ball()))
    assert caught.value.reason == "FORMAT_NOT_SUPPORTED"
    assert "pip install 'regnf[cad]'" in str(caught.value.hint)


def test_quantized_places_are_read_as_their_node_scales_them() -> None:
    places = np.array([[-32767, 0, 0], [32767, 0, 0], [0, 16384, 0]], "<i2")
    accessor = {"bufferView": 0, "componentType": 5122, "count": 3, "type": "VEC3"}
    for normalized, factor in ((True, 32767.0), (False, 1.0)):
        document = {
            "asset": {"version": "2.0"},
            "nodes": [{"mesh": 0, "scale": [2, 2, 2], "translation": [0, 0, 5]}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [{**accessor, "normalized": normalized}],
            "bufferViews": [{"buffer": 0, "byteLength": 24, "byteStride": 8}],
            "buffers": [{"byteLength": 24}],
            "extensionsRequired": ["KHR_mesh_quantization"],
        }
        data = np.zeros((3, 4), "<i2")
        data[:, :3] = places
        found = read_mesh("glb", memoryview(glb(document, data.tobytes())))
        np.testing.assert_allclose(found.vertices, 2.0 * places / factor + [0, 0, 5])
