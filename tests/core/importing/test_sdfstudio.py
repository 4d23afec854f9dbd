from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.legacy_container import read_archive
from regnf_core.importing.families import convert_checkpoint
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import assert_refused
from tests.core.importing.checkpoints import checkpoint

F = "_model.field."


def convert(values: object, **description: Any) -> ConvertedField:
    buffer = io.BytesIO()
    torch.save(values, buffer)
    archive = read_archive(memoryview(buffer.getvalue()))
    source = TensorSource(archive, 1 << 30)
    return convert_checkpoint(read_pickle(archive.read("data.pkl")), source, UploadDescription.from_dict(description))


def changed(change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """A small checkpoint after ``change`` has been at its pipeline."""
    values = checkpoint()
    change(values["pipeline"])
    return values


def test_only_the_distance_and_its_color_are_kept() -> None:
    values = checkpoint(log2_size=14)
    converted = convert(values)
    names = {f"layers.{i}.{part}" for i in range(3) for part in ("weight", "bias")}
    colors = {f"color.layers.{i}.{part}" for i in range(2) for part in ("weight", "bias")}
    assert set(converted.tensors) == {"hash_table", *names, *colors}
    assert set(convert(values, color={"keep": False}).tensors) == {"hash_table", *names}
    assert converted.tensors["layers.2.weight"].shape == (1, 64)
    assert converted.family == "sdfstudio_neus_facto"
    assert [warning.partition(":")[0] for warning in converted.warnings] == ["COLOR_ASSUMED"]
    table = values["pipeline"][F + "encoding.params"].numpy().reshape(-1, 2)
    np.testing.assert_array_equal(converted.tensors["hash_table"], table)


def test_weight_normalization_is_folded_in_and_plain_weights_are_taken_as_they_are() -> None:
    def change(pipeline: dict[str, Any]) -> None:
        pipeline[F + "glin0.weight_v"] *= 3.0
        pipeline[F + "glin0.weight_g"] *= 2.0
        pipeline[F + "glin1.weight"] = pipeline.pop(F + "glin1.weight_v")
        del pipeline[F + "glin1.weight_g"]

    before, tensors = checkpoint()["pipeline"], convert(changed(change)).tensors
    np.testing.assert_allclose(tensors["layers.0.weight"], 2.0 * before[F + "glin0.weight_v"], rtol=1e-6)
    np.testing.assert_array_equal(tensors["layers.1.weight"], before[F + "glin1.weight_v"])


def test_a_distributed_run_in_half_precision_is_the_same_family() -> None:
    values = checkpoint(prefix="_model.module.field.")
    values["pipeline"] = {key: value.half() for key, value in values["pipeline"].items()}
    converted = convert(values)
    assert converted.family == "sdfstudio_neus_facto"
    assert "_model.field.glin*" in converted.why[0]
    assert converted.tensors["hash_table"].dtype == np.float32


def test_nerfstudio_is_told_by_what_it_lacks() -> None:
    converted = convert(changed(lambda pipeline: pipeline.pop(F + "laplace_density.beta")))
    assert converted.family == "nerfstudio_neus_facto"
    assert converted.description["positional_encoding"]["two_pi"] is True
    assert converted.description["contraction"] == "linf_grid"


def test_the_uploader_may_overrule() -> None:
    converted = convert(
        checkpoint(), family="nerfstudio_neus_facto", contraction="linf", level_mask=4, label="chair", hash={}
    )
    description = converted.description
    assert converted.family == "nerfstudio_neus_facto"
    assert description["positional_encoding"]["two_pi"] is True
    assert (description["contraction"], description["level_mask"], description["label"]) == ("linf", 4, "chair")
    assert_refused(lambda: convert(checkpoint(), family="siren"), "FAMILY_NOT_SUPPORTED")


FAULTY: dict[str, list[Any]] = {
    "surprise": [1],
    "contraction": ["sphere"],
    "level_mask": [0, "4", True],
    "label": ["x" * 201, 7],
    "sign": [0, True, -1.5],
    "world_scale": [0, "2"],
    "bounds": [[[0, 0, 0]], [[0, 0, 0], [1, 1, 0]], [[0, 0], [1, 1]], [[0, 0, 0], [1, 1, "1"]]],
    "latent_index": [-1],
    "latent": [[], [0.0] * 513],
    "up_axis": ["w"],
    "hash": [{"layers": 3}, {"levels": 0}, []],
    "positional_encoding": [{"degree": -1}],
    "as_": ["scene"],
    "as": ["room"],
    "frame": ["world"],
    "dataset_transform": [[[1.0, 0.0, 0.0, 0.0]] * 4, np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()],
    "accept_implausible": [1],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in FAULTY.items() for value in values])
def test_faulty_descriptions_are_refused(name: str, value: Any) -> None:
    assert_refused(lambda: UploadDescription.from_dict({name: value}), "INVALID_DESCRIPTION")


def test_encodings_that_were_never_used_are_left_out() -> None:
    no_grid, no_sines = (
        convert(changed(lambda pipeline, columns=columns: pipeline[F + "glin0.weight_v"][:, columns].zero_()))
        for columns in (slice(39, None), slice(3, 39))
    )
    assert no_grid.description["use_grid"] is False
    assert "hash_table" not in no_grid.tensors
    assert no_sines.description["positional_encoding"]["used"] is False


def test_bounds_come_from_the_aabb_or_are_assumed_aloud() -> None:
    box = torch.tensor([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.5]])
    converted = convert(changed(lambda pipeline: pipeline.update({F + "aabb": box})))
    assert converted.description["bounds"] == box.tolist()
    assumed = convert(changed(lambda pipeline: pipeline.pop(F + "aabb")))
    assert assumed.description["bounds"] == [[-1.0] * 3, [1.0] * 3]
    assert [w.split(":")[0] for w in assumed.warnings] == ["BOUNDS_ASSUMED", "COLOR_ASSUMED"]
    empty = changed(lambda pipeline: pipeline.update({F + "aabb": box.flip(0)}))
    assert_refused(lambda: convert(empty), "BOUNDS_INVALID")


def put(name: str, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda pipeline: pipeline.update({F + name: value})


def drop(name: str) -> Callable[[dict[str, Any]], object]:
    return lambda pipeline: pipeline.pop(F + name)


class _Odd:
    """An object whose class the reader does not know."""


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (drop("glin1.bias"), "TENSOR_MISSING"),
        (drop("glin2.weight_g"), "TENSOR_MISSING"),
        (drop("encoding.params"), "TENSOR_MISSING"),
        (put("glin5.bias", torch.zeros(3)), "TENSOR_MISSING"),
        (put("glin3.bias", torch.zeros(3)), "TENSOR_MISSING"),
        (put("glin1.weight_v", torch.ones(64, 63)), "TENSOR_SHAPE"),
        (put("glin1.weight_v", torch.ones(64)), "TENSOR_SHAPE"),
        (put("glin1.weight_g", torch.ones(64)), "TENSOR_SHAPE"),
        (put("glin1.bias", torch.ones(65)), "TENSOR_SHAPE"),
        (put("aabb", torch.ones(6)), "TENSOR_SHAPE"),
        (put("encoding.params", torch.ones(8192, 1)), "TENSOR_SHAPE"),
        (put("encoding.params", torch.ones(8190)), "HASH_GRID_NOT_RECOGNIZED"),
        (put("glin0.weight_v", torch.zeros(64, 71)), "TENSOR_NOT_FINITE"),
        (put("glin1.bias", torch.full((64,), float("nan"))), "TENSOR_NOT_FINITE"),
        (put("glin1.bias", torch.ones(64, dtype=torch.int64)), "TENSOR_DTYPE"),
        (put("glin1.bias", [0.0] * 64), "TENSOR_EXPECTED"),
        (put("glin1.bias", _Odd()), "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (put("encoding.params", torch.ones(4, 4).to_sparse()), "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (put("glin0.weight_v", torch.ones(64, 39)), "FAMILY_NOT_SUPPORTED"),  # no columns for the grid
    ],
)
def test_faulty_weights_are_refused(change: Callable[[dict[str, Any]], object], reason: str) -> None:
    assert_refused(lambda: convert(changed(change)), reason)


def test_odd_objects_beside_the_weights_do_no_harm() -> None:
    values = checkpoint() | {"config": _Odd(), "hooks": [_Odd()]}
    values["pipeline"]["_model.callback"] = _Odd()
    assert convert(values).family == "sdfstudio_neus_facto"


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({}, "FIELD_NOT_RECOGNIZED"),
        ([1, 2], "FIELD_NOT_RECOGNIZED"),
        ({"pipeline": {}}, "FIELD_NOT_RECOGNIZED"),
        ({"pipeline": [1]}, "FIELD_NOT_RECOGNIZED"),
        ({"pipeline": {F + "encoding.params": torch.ones(8)}}, "FIELD_NOT_RECOGNIZED"),
        ({"pipeline": _Odd()}, "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (_Odd(), "UNSAFE_GLOBAL_IN_WEIGHTS"),
        ({"neural_points": 1}, "FAMILY_NOT_SUPPORTED"),
        ({"model": {"encoder.embeddings": 1}}, "FIELD_NOT_RECOGNIZED"),
        ({"model_state_dict": {"in_layer.0.weight": torch.ones(3)}}, "FIELD_NOT_RECOGNIZED"),
    ],
)
def test_other_files_are_refused(values: object, reason: str) -> None:
    assert_refused(lambda: convert(values), reason)


def test_the_refusal_of_a_whole_module_says_what_to_do() -> None:
    with pytest.raises(FieldFormatError, match="state_dict"):
        convert(torch.nn.Linear(2, 2))
