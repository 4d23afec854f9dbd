"""Checkpoints whose weights are not what they should be, each with what becomes of it."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tests.core.importing.archives import tensor
from tests.core.importing.checkpoints import checkpoint
from tests.core.importing.fuzzing.seeds import Seeds
from tests.gate.bad_containers import Build, Files
from tests.gate.bad_pickles import UNSAFE, WEIGHT, weight

F = "_model.field."
Change = Callable[[dict[str, Any]], object]


def saved(change: Change) -> Build:
    """A small checkpoint as torch saves it, after a change to its state."""

    def build(_: object) -> bytes:
        values = checkpoint(log2_size=8, hidden=6, optimizer=False)
        change(values["pipeline"])
        buffer = io.BytesIO()
        torch.save(values, buffer)
        return buffer.getvalue()

    return build


def put(name: str, value: Callable[[Tensor], Any]) -> Build:
    """One weight replaced by something made from it."""
    return saved(lambda state: state.update({F + name: value(state[F + name])}))


def filled(value: float) -> Callable[[Tensor], Tensor]:
    return lambda found: torch.full_like(found, value)


def constant(state: dict[str, Any]) -> None:
    """Nothing but the last bias reaches the output: there is no surface."""
    for layer in (0, 1, 2):
        state[f"{F}glin{layer}.weight_g"].zero_()


def renamed(state: dict[str, Any]) -> None:
    for name in [name for name in state if name.startswith(F + "glin")]:
        state[name.replace("glin", "layer")] = state.pop(name)


def another_layer(state: dict[str, Any]) -> None:
    for part in ("bias", "weight_g", "weight_v"):
        state[f"{F}glin3.{part}"] = state[f"{F}glin1.{part}"].clone()


def without(name: str) -> Build:
    return saved(lambda state: state.pop(F + name))


def from_a_gpu(seeds: Seeds) -> bytes:
    """A sound weight whose storage was saved from a device that this machine need not have."""
    key = next(key for name, key, _ in seeds.tensors if name == WEIGHT)
    return weight(tensor(key, (6,), (1,), device="cuda:0"))(seeds)


class Wrapped(torch.Tensor):
    """A subclass of our own, which nobody who loads the file has."""


class Thing:
    """An object that is no tensor."""


TENSORS: Files = {
    "sparse": (put("glin1.bias", lambda found: found.to_sparse()), UNSAFE),
    "sparse, lying about its size": (
        weight(b"ctorch._utils\n_rebuild_sparse_tensor\n(K\x00(" + tensor("0", (1, 1), (1, 1)) + b"ttR"),
        UNSAFE,
    ),
    "a quantized stride": (
        weight(b"ctorch._utils\n_rebuild_qtensor\n(" + tensor("0", (6,), (1,), kind="QInt8Storage") + b"tR"),
        UNSAFE,
    ),
    "stride 0 of 10^12 elements": (
        weight(tensor("0", (10**6, 10**6), (0, 0), count=6)),
        "rejected TENSOR_TOO_LARGE",
    ),
    "a bad offset": (weight(tensor("0", (6,), (1,), offset=3)), "rejected TENSOR_STORAGE_MISMATCH"),
    "complex": (put("glin1.bias", lambda found: found.to(torch.complex64)), "rejected TENSOR_DTYPE"),
    "integers": (put("glin1.bias", lambda found: found.long()), "rejected TENSOR_DTYPE"),
    "an object": (put("glin1.bias", lambda _: Thing()), UNSAFE),
    "meta": (put("glin1.bias", lambda found: found.to("meta")), UNSAFE),
    "meta, as a storage's device": (weight(tensor("0", (6,), (1,), device="meta")), "rejected TENSOR_DEVICE"),
    "from a GPU": (from_a_gpu, "ready"),
    "a subclass": (put("glin1.bias", lambda found: found.as_subclass(Wrapped)), UNSAFE),
    "NaN weights": (put("glin1.bias", filled(math.nan)), "rejected TENSOR_NOT_FINITE"),
    "Inf weights": (put("glin1.bias", filled(math.inf)), "rejected TENSOR_NOT_FINITE"),
    "weights that overflow": (put("glin0.weight_g", filled(1e38)), "rejected FIELD_NOT_FINITE"),
    "a constant field": (saved(constant), "rejected NO_ZERO_LEVEL"),
    "a missing layer's bias": (without("glin1.bias"), "rejected TENSOR_MISSING"),
    "a missing table": (without("encoding.params"), "rejected TENSOR_MISSING"),
    "renamed layers": (saved(renamed), "rejected FIELD_NOT_RECOGNIZED"),
    "an extra layer": (saved(another_layer), "rejected TENSOR_SHAPE"),
    "wrong shapes": (put("glin1.weight_v", lambda found: found[:, 1:].clone()), "rejected TENSOR_SHAPE"),
    "a transposed weight": (put("glin0.weight_v", lambda found: found.t().contiguous()), "rejected TENSOR_SHAPE"),
    "a view of more": (
        put("glin1.bias", lambda found: torch.cat([found, found])[:6]),
        "rejected TENSOR_STORAGE_MISMATCH",
    ),
    "lists for tensors": (put("glin1.bias", lambda found: found.tolist()), "rejected TENSOR_EXPECTED"),
    "a table of 2^60 rows, none of them there": (
        weight(tensor("90", (0, 1 << 47, 1 << 47), (1 << 47, 1 << 47, 1))),
        "rejected TENSOR_SHAPE",
    ),
}
