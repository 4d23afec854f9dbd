"""What the families' networks compute, one point after another, in float64: straight from the papers, and apart."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = Mapping[str, Any]


def array(state: State, name: str) -> Array:
    return np.asarray(state[name].detach().double().numpy())


def linear(state: State, name: str, h: Array) -> Array:
    """A layer by name, its weight perhaps split into direction and length."""
    if f"{name}.weight" in state:
        weight = array(state, f"{name}.weight")
    else:
        v, g = array(state, f"{name}.weight_v"), array(state, f"{name}.weight_g")
        weight = v * (g / np.sqrt((v * v).sum(axis=1, keepdims=True)))
    a = weight @ h
    return a + array(state, f"{name}.bias") if f"{name}.bias" in state else a


def waves(x: Array, degree: int) -> Array:
    """[x, sin x, cos x, sin 2x, cos 2x, sin 4x ...] of NeRF."""
    parts = [x]
    for k in range(degree):
        parts += [np.sin(2.0**k * x), np.cos(2.0**k * x)]
    return np.concatenate(parts)


def implicit(state: State, x: Array, degree: int, scale: float = 1.0, beta: float = 100.0) -> Array:
    """NeuS's network: all results, at one point. Where a layer is too wide it sees [h, input] / sqrt 2."""
    given = h = waves(scale * x, degree)
    count = sum(1 for name in state if name.endswith(".bias"))
    for i in range(count):
        columns = state.get(f"lin{i}.weight", state.get(f"lin{i}.weight_v")).shape[1]
        if i and columns != len(h):
            h = np.concatenate((h, given)) / math.sqrt(2.0)
        h = linear(state, f"lin{i}", h)
        if i < count - 1:
            h = np.logaddexp(beta * h, 0.0) / beta
    return h / scale


def deepsdf(state: State, latent: Array, x: Array, use_tanh: bool) -> float:
    given = h = np.concatenate((latent, x))
    count = sum(1 for name in state if name.startswith("lin") and name.endswith(".bias"))
    for i in range(count):
        columns = state.get(f"lin{i}.weight", state.get(f"lin{i}.weight_v")).shape[1]
        if columns == len(h) + len(given) and i:
            h = np.concatenate((h, given))
        elif columns != len(h):
            h = np.concatenate((h, x))
        h = linear(state, f"lin{i}", h)
        if i < count - 1:
            if f"bn{i}.weight" in state:
                h = (h - h.mean()) / np.sqrt(((h - h.mean()) ** 2).mean() + 1e-5)
                h = h * array(state, f"bn{i}.weight") + array(state, f"bn{i}.bias")
            h = np.maximum(h, 0.0)
    return math.tanh(math.tanh(h[0])) if use_tanh else math.tanh(h[0])


def siren(state: State, x: Array, omega: float, first: float | None = None) -> float:
    h, count = x, len(state) // 2
    for i in range(count - 1):
        a = linear(state, f"net.net.{i}.0", h)
        h = np.sin((first or omega if i == 0 else omega) * a)
    return float(linear(state, f"net.net.{count - 1}.0", h)[0])
