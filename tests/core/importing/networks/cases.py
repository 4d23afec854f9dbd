"""Random configurations of each family of plain networks: a checkpoint, what its settings say, and its function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tests.core.importing.networks import slow_network as slow
from tests.core.importing.networks.trained import Decoder, Implicit, Sines, split
from tests.core.importing.networks.training import in_ball, in_cube, random_shape, train

Array = NDArray[np.float64]
State = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """said: the description that the trainer's settings amount to · beside: what is no setting (a latent code)."""

    checkpoint: State
    said: dict[str, Any]
    beside: dict[str, Any]
    function: Callable[[Array], float]
    told: str


def _numbers(state: State) -> State:
    return {name: value.detach().clone() for name, value in state.items()}


def _trained(
    network: torch.nn.Module, rng: np.random.Generator, steps: int, ball: bool, clamp: float | None = None
) -> None:
    """Trained for so many steps; or, for none, at random with about as much of the cube inside as outside."""
    if steps:
        sampler, seed = in_ball(1.0) if ball else in_cube(1.0), int(rng.integers(1 << 30))
        train(network, list(network.parameters()), random_shape(rng), sampler, seed, steps, 2e-3, clamp)
        return
    generator = torch.Generator().manual_seed(int(rng.integers(1 << 30)))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * parameter.std(correction=0) * torch.randn(parameter.shape, generator=generator))
        last = list(network.parameters())[-1]
        points = 2.0 * torch.rand(400, 3, generator=generator) - 1.0
        low, high = last - 20.0, last + 20.0
        for _ in range(60):  # the result grows with the last bias
            last.copy_((low + high) / 2.0)
            above = bool(network(points).median() > 0.0)
            low, high = (low, last.clone()) if above else (last.clone(), high)


def neus(rng: np.random.Generator, steps: int) -> Case:
    degree, scale = int(rng.integers(0, 7)), float(rng.choice([1.0, 1.0, 1.0, 3.0, 2.0]))
    layers = int(rng.integers(4, 7))
    skips = (layers // 2,) if rng.random() < 0.7 else ()
    network = Implicit(rng, degree, 48, layers, skips, scale, results=int(rng.choice([1, 9])))
    _trained(network, rng, steps, ball=True)
    state = _numbers(network.state_dict())
    saved = split(state, [f"lin{i}" for i in range(layers)]) if rng.random() < 0.8 else state
    return Case(
        {"sdf_network_fine": saved, "iter_step": 300_000},
        {"input_scale": scale},
        {},
        lambda x: float(slow.implicit(saved, x, degree, scale)[0]),
        f"degree {degree}, scale {scale:g}, {layers} layers, skips {skips}",
    )


def deepsdf(rng: np.random.Generator, steps: int) -> Case:
    latent, layers, use_tanh = int(rng.integers(0, 17)), int(rng.integers(4, 8)), bool(rng.random() < 0.3)
    inside = (layers // 2,) if rng.random() < 0.7 else ()
    norms, in_all = bool(rng.random() < 0.3), bool(rng.random() < 0.3)
    network = Decoder(rng, latent, 48, layers, inside, in_all, norms, use_tanh)
    _trained(network, rng, steps, ball=True, clamp=0.1)
    state = _numbers(network.state_dict())
    saved = state if norms else split(state, [f"lin{i}" for i in range(layers - 1)])
    code = network.code.double().numpy()
    beside = {"latent": network.code.tolist()} if latent else {}
    return Case(
        {"epoch": 2000, "model_state_dict": {f"module.{name}": value for name, value in saved.items()}},
        {"output_tanh": 2 if use_tanh else 1},
        beside,
        lambda x: slow.deepsdf(saved, code, x, use_tanh),
        f"latent {latent}, {layers} layers, latent_in {inside}, in all {in_all}, norms {norms}, use_tanh {use_tanh}",
    )


def siren(rng: np.random.Generator, steps: int) -> Case:
    omega, layers = float(rng.choice([30.0, 30.0, 20.0, 15.0, 10.0])), int(rng.integers(3, 6))
    first = float(rng.choice([10.0, 30.0])) if rng.random() < 0.2 else None
    network = Sines(rng, 40, layers, omega, first)
    _trained(network, rng, steps, ball=False)
    state = {f"net.{name}": value for name, value in _numbers(network.state_dict()).items()}
    said = {"activation_scale": omega} | ({"first_activation_scale": first} if first is not None else {})
    return Case(
        state,
        said,
        {},
        lambda x: slow.siren(state, x, omega, first),
        f"omega {omega:g}, first {first}, {layers} layers",
    )


FAMILIES: dict[str, Callable[[np.random.Generator, int], Case]] = {"neus": neus, "deepsdf": deepsdf, "siren": siren}
