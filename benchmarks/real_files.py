"""Checkpoints of public repositories, read by the gate and compared with an evaluation that shares no code with it.

    python -m benchmarks.real_files --folder REPOSITORIES

REPOSITORIES holds what the reader has fetched: folders of DeepSDF runs (specs.json, ModelParameters, LatentCodes),
DeepSDF in blocks (weights.pt with net.*.0, read with a code of zeros), SIREN (model_final.pth, read with the published
factor of 30), and .onnx models of points to distances in the first column. Nothing of it belongs into this repository.
Prints a table: what loads, by how much values differ (of their range) and gradients (of the longest), or why a file is
refused.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.errors import RegnfError
from regnf_core.field_source import find_source
from regnf_core.loading import load_field

Function = Callable[[Tensor], Tensor]
_POINTS = 1000
_BLOCKS_SKIP = 3
"""Behind how many blocks the published network sees its input again."""


@dataclass(frozen=True)
class File:
    """said: the description that the gate gets · function: points (N, 3) to distances (N,), in float64."""

    path: Path
    function: Function
    said: dict[str, Any] = field(default_factory=dict)


def files(folder: Path) -> Iterator[File]:
    """What is known under ``folder``."""
    for specs in sorted(folder.rglob("specs.json")):
        model = specs.parent / "ModelParameters" / "latest.pth"
        if model.is_file():
            yield File(specs.parent, deepsdf(specs, model))
    for weights in sorted(folder.rglob("weights.pt")):
        said = {"latent": [0.0] * 64, "skip_layer": _BLOCKS_SKIP, "output_tanh": 1}
        yield File(weights, blocks(weights), said)
    for weights in sorted(folder.rglob("model_final.pth")):
        yield File(weights, siren(weights), {"activation_scale": 30.0})
    for model in sorted(folder.rglob("*.onnx")):
        yield File(model, graph(model))


def deepsdf(specs: Path, model: Path) -> Function:
    """The published decoder: layers and ReLU, the input once more where ``latent_in`` says, tanh once or twice."""
    settings = json.loads(specs.read_text())
    network = settings["NetworkSpecs"]
    state = {name.removeprefix("module."): tensor.double() for name, tensor in _load(model)["model_state_dict"].items()}
    codes = _load(specs.parent / "LatentCodes" / "latest.pth")["latent_codes"]
    code = (codes["weight"] if isinstance(codes, dict) else codes)[0].reshape(-1).double()
    layers = len(network["dims"]) + 1

    def evaluate(points: Tensor) -> Tensor:
        given = torch.cat((code.expand(len(points), -1), points), dim=1)
        x = given
        for i in range(layers):
            if i in network["latent_in"]:
                x = torch.cat((x, given), dim=1)
            x = x @ _weight(state, f"lin{i}").T + state[f"lin{i}.bias"]
            if i == layers - 1 and network["use_tanh"]:
                x = x.tanh()
            if i < layers - 1:
                x = x.relu()
        distance: Tensor = x[:, 0].tanh()
        return distance

    return evaluate


def blocks(weights: Path) -> Function:
    """A code of zeros and the point; the input once more, behind a narrower layer."""
    state = {name: tensor.double() for name, tensor in _load(weights).items()}
    count = len([name for name in state if name.startswith("net.") and name.endswith(".bias")])

    def evaluate(points: Tensor) -> Tensor:
        width = _weight(state, "net.0.0").shape[1]
        given = torch.cat((torch.zeros(len(points), width - 3, dtype=points.dtype), points), dim=1)
        x = given
        for i in range(count):
            if i == _BLOCKS_SKIP:
                x = (x @ _weight(state, "skip_layer.0").T + state["skip_layer.0.bias"]).relu()
                x = torch.cat((x, given), dim=1)
            x = (x @ _weight(state, f"net.{i}.0").T + state[f"net.{i}.0.bias"]).relu()
        x = x @ _weight(state, "final_layer.0").T + state["final_layer.0.bias"]
        distance: Tensor = x[:, 0].tanh()
        return distance

    return evaluate


def siren(weights: Path) -> Function:
    """Sines of 30 times what the layers give."""
    state = {name: tensor.double() for name, tensor in _load(weights).items()}
    layers = sum(name.endswith(".bias") for name in state)

    def evaluate(points: Tensor) -> Tensor:
        x = points
        for i in range(layers):
            x = x @ state[f"net.net.{i}.0.weight"].T + state[f"net.net.{i}.0.bias"]
            if i < layers - 1:
                x = (30 * x).sin()
        return x[:, 0]

    return evaluate


def graph(model: Path) -> Function:
    """By the reference implementation of ONNX, as many points at once as the model was made for."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    proto = onnx.load(model)
    runner, given = ReferenceEvaluator(proto), proto.graph.input[0]
    batch = given.type.tensor_type.shape.dim[0].dim_value or _POINTS

    def evaluate(points: Tensor) -> Tensor:
        found = []
        for start in range(0, len(points), batch):
            part = points.detach()[start : start + batch].float()
            padded = torch.cat((part, torch.zeros(batch - len(part), 3))).numpy()
            made: Any = runner.run(None, {given.name: padded})
            found.append(np.asarray(made[0]).reshape(batch, -1)[: len(part), 0])
        return torch.from_numpy(np.concatenate(found)).double()

    return evaluate


def _load(path: Path) -> Any:
    return torch.load(path, map_location="cpu", weights_only=True)


def _weight(state: dict[str, Tensor], name: str) -> Tensor:
    for length, direction in (
        ("parametrizations.weight.original0", "parametrizations.weight.original1"),
        ("weight_g", "weight_v"),
    ):
        if f"{name}.{length}" in state:
            rows = state[f"{name}.{direction}"]
            factor: Tensor = state[f"{name}.{length}"] / torch.linalg.vector_norm(rows, dim=1, keepdim=True)
            return factor * rows
    return state[f"{name}.weight"]


def row(file: File, folder: Path) -> str:
    """A line of the table."""
    name = str(file.path.relative_to(folder))
    try:
        loaded = load_field(find_source(file.path, file.said))
    except RegnfError as error:
        return f"| {name} | {error.reason} | {str(error).removeprefix(str(file.path)).lstrip(': ')} | | |"
    low, high = loaded.field.bounds
    points = low + (high - low) * torch.rand(
        _POINTS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5)
    )
    values, gradients = loaded.field.signed_distance_and_gradient(points.float())
    points = points.float().double().requires_grad_(True)
    expected = file.function(points)
    known = expected.detach()
    value = float((values.double() - known).abs().max() / (known.max() - known.min()))
    slope = "-"
    if expected.requires_grad:
        (true,) = torch.autograd.grad(expected.sum(), points)
        off = (gradients.double() - true).norm(dim=1)
        # at a kink of ReLU either side's gradient is right
        slope = f"{float(off.quantile(0.99)) / float(true.norm(dim=1).max()):.1e}"
    words = ", ".join(loaded.notes.words) or "none"
    return f"| {name} | {loaded.notes.family} | warnings: {words} | {value:.1e} | {slope} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="where the repositories' files are")
    folder = parser.parse_args().folder
    print("| file | read as | | values, of the range | gradients, 99 % |")
    print("|---|---|---|---|---|")
    for file in files(folder):
        print(row(file, folder), flush=True)


if __name__ == "__main__":
    main()
