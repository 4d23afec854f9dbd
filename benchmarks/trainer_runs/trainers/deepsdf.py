"""DeepSDF: ``specs.json`` beside ``ModelParameters/`` and ``LatentCodes/``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.run import WrittenRun, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train

_CLAMP = 0.1


class _Decoder:
    """The network of [code, position], as the paper's supplement describes it."""

    def __init__(self, rng: np.random.Generator, said: dict[str, Any], code: int) -> None:
        self.said, self.code = said, code
        widths = [code + 3, *said["dims"], 1]
        self.weights: list[Tensor] = []
        self.biases: list[Tensor] = []
        self.norms: dict[int, tuple[Tensor, Tensor]] = {}
        last = len(widths) - 2
        for i in range(last + 1):
            rows = widths[i + 1] - (widths[0] if i + 1 in said["latent_in"] else 0)
            if said["xyz_in_all"] and i != last:
                rows -= 3
            bound = 1 / np.sqrt(widths[i])
            self.weights.append(_parameter(rng.uniform(-bound, bound, (rows, widths[i])) * np.sqrt(2)))
            self.biases.append(_parameter(rng.uniform(-bound, bound, rows)))
            if not said["weight_norm"] and i in said["norm_layers"] and i != last:
                self.norms[i] = (_parameter(rng.uniform(0.8, 1.2, rows)), _parameter(rng.normal(0, 0.1, rows)))

    def __call__(self, code: Tensor, x: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        whole = torch.cat((code.to(dtype).expand(len(x), -1), x), dim=1)
        hidden = whole
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if i in self.said["latent_in"]:
                hidden = torch.cat((hidden, whole), dim=1)
            elif i and self.said["xyz_in_all"]:
                hidden = torch.cat((hidden, x), dim=1)
            hidden = hidden @ weight.to(dtype).T + bias.to(dtype)
            if i < len(self.weights) - 1:
                if i in self.norms:
                    gain, shift = (part.to(dtype) for part in self.norms[i])
                    hidden = torch.nn.functional.layer_norm(hidden, hidden.shape[1:], gain, shift)
                hidden = torch.relu(hidden)
        if self.said["use_tanh"]:
            hidden = torch.tanh(hidden)
        return torch.tanh(hidden)[:, 0]

    def parameters(self) -> list[Tensor]:
        """All that is trained."""
        return [*self.weights, *self.biases, *(part for pair in self.norms.values() for part in pair)]


def _parameter(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, requires_grad=True)


def write_deepsdf(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run of random depth, width, skips, normalization and final tanh; the shape is one of three codes."""
    depth, width, code = int(rng.integers(3, 9)), int(rng.choice([64, 96, 128])), int(rng.choice([4, 8, 16, 32]))
    everywhere = bool(rng.random() < 0.25)
    said = {
        "dims": [width] * depth,
        "dropout": list(range(depth)),
        "dropout_prob": 0.2,
        "norm_layers": list(range(depth))
        if rng.random() < 0.8
        else sorted({int(n) for n in rng.integers(0, depth, 2)}),
        "latent_in": [] if everywhere or depth < 3 else [int(rng.integers(2, depth))],
        "xyz_in_all": everywhere,
        "use_tanh": bool(rng.random() < 0.5),
        "latent_dropout": False,
        "weight_norm": bool(rng.random() < 0.7),
    }
    decoder = _Decoder(rng, said, code)
    codes = torch.tensor(rng.normal(0, 0.3, (3, code)), dtype=torch.float32)
    index = int(rng.integers(0, 3))
    train(lambda x: decoder(codes[index], x), decoder.parameters(), random_shape(rng), rng, steps, 1e-3, _CLAMP)
    checkpoint = folder / "examples" / "things" / "ModelParameters" / "latest.pth"
    checkpoint.parent.mkdir(parents=True)
    torch.save({"epoch": 2000, "model_state_dict": _state(rng, decoder)}, checkpoint)
    run = checkpoint.parent.parent
    (run / "LatentCodes").mkdir()
    torch.save({"epoch": 2000, "latent_codes": {"weight": codes}}, run / "LatentCodes" / "latest.pth")
    specs = {
        "Description": ["a thing"],
        "NetworkArch": "deep_sdf_decoder",
        "NetworkSpecs": said,
        "CodeLength": code,
        "NumEpochs": 2001,
        "ClampingDistance": _CLAMP,
    }
    (run / "specs.json").write_text(json.dumps(specs, indent=2))
    return WrittenRun(
        folder,
        checkpoint,
        {**said, "code": code},
        lambda x: decoder(codes[index], x, torch.float64),
        description={"latent_index": index},
    )


def _state(rng: np.random.Generator, decoder: _Decoder) -> dict[str, Tensor]:
    state = {}
    for i, (weight, bias) in enumerate(zip(decoder.weights, decoder.biases, strict=True)):
        factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
        is_normed = decoder.said["weight_norm"] and i in decoder.said["norm_layers"]
        parts = normalized(weight, factors) if is_normed else {"weight": weight.detach()}
        state |= {f"module.lin{i}.{name}": part for name, part in {**parts, "bias": bias.detach()}.items()}
    for i, (gain, shift) in decoder.norms.items():
        state |= {f"module.bn{i}.weight": gain.detach(), f"module.bn{i}.bias": shift.detach()}
    return state
