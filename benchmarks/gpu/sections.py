"""The sections of the report: what each measures, and the table of it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from benchmarks.gpu.deadline import Deadline
from benchmarks.gpu.pairs import Pair, batch_of, field_at, model_at
from benchmarks.gpu.report import Section
from regnf_core import RegistrationOptions, RegistrationResult, RegnfError
from regnf_core.batch import BatchOutcome, ModeledObject, register_batch
from regnf_core.library import register

MOST_APART = 1e-4
"""Diameters. Largest distance between the CPU's pose and the device's."""
POINTS = 100_000
ORDER_PAIRS = 6
DEVIATIONS_APART = 0.1
"""Largest relative difference of a pose's standard deviations. They follow from the residuals, and those of exact
fields are hardly larger than what two poses may be apart."""
VALUES_APART = 1e-4
"""Largest difference of field values, as a share of the field's extent."""
ALONE = RegistrationOptions()


def evaluator(pairs: Sequence[Pair], device: torch.device, repeats: int) -> Section:
    """Value and gradient of each field at points spread over its bounds."""
    rows, met = [], True
    for path in dict.fromkeys([pair.room for pair in pairs] + [pair.object for pair in pairs]):
        here, there = field_at(path, "cpu"), field_at(path, str(device))
        low, high = (corner.float() for corner in here.bounds)
        points = low + torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0)) * (high - low)
        moved = points.to(device)
        seconds = _median_seconds(lambda there=there, moved=moved: there.signed_distance_and_gradient(moved), repeats)
        value, gradient = here.signed_distance_and_gradient(points)
        other, slope = there.signed_distance_and_gradient(moved)
        apart = float((value - other.cpu()).abs().max() / (high - low).norm())
        turned = float((gradient - slope.cpu()).norm(dim=-1).quantile(0.999))
        met &= apart <= VALUES_APART
        rows.append([path.stem, f"{POINTS / seconds / 1e6:.2f}", f"{apart:.1e}", f"{turned:.1e}"])
    head = ("field", "million evaluations a second", "values apart", "gradients apart, 99.9th percentile")
    note = "Value with gradient; apart: from the CPU's, values as a share of the field's extent."
    return Section("Evaluator", head, rows, [note], met)


def single(pairs: Sequence[Pair], device: torch.device, repeats: int, deadline: Deadline) -> Section:
    """Registrations of right pairs, one after the other, the object's model kept."""
    rows = []
    for pair in _right(pairs):
        found = []
        _registered(pair, device, 0)
        for seed in range(repeats):
            if deadline.left < 0 and found:
                break
            begun = time.perf_counter()
            _registered(pair, device, seed)
            found.append(time.perf_counter() - begun)
        found.sort()
        worst = found[min(len(found) - 1, int(0.95 * len(found)))]
        rows.append([pair.name, f"{1e3 * statistics.median(found):.0f}", f"{1e3 * worst:.0f}", str(len(found))])
    return Section("One registration", ("pair", "median ms", "95th percentile ms", "runs"), rows)


def batches(pairs: Sequence[Pair], device: torch.device, sizes: Sequence[int], deadline: Deadline) -> Section:
    """``register_batch`` of right pairs of one room, each with a box of its own, the objects' models kept."""
    rows, notes = [], []
    for size in sizes:
        if deadline.left < 0:
            notes.append(f"Left out for want of time: {size} pairs.")
            continue
        some = batch_of(pairs, size)
        _batch(some[:1], device)
        _reset_peak(device)
        begun = time.perf_counter()
        found = _batch(some, device)
        seconds = time.perf_counter() - begun
        good = sum(one.result is not None and one.result.verdict == "registered" for one in found)
        rows.append([str(size), f"{1e3 * seconds / size:.0f}", f"{good} of {size}", _peak(device)])
    head = ("pairs", "ms a pair", "registered", "peak memory of the device, MiB")
    notes.append("The memory includes the fields.")
    return Section("Batches", head, rows, notes)


def order(pairs: Sequence[Pair], device: torch.device, deadline: Deadline) -> Section:
    """Whether a pair's result depends on the other pairs of its batch."""
    title, head = "Pairs in another company", ("results compared", "the same bit by bit", "largest distance, diameters")
    if deadline.left < 0:
        return Section(title, head, [], ["Left out for want of time."])
    some = batch_of(pairs, ORDER_PAIRS)
    whole = _batch(some, device)
    turned = _batch(some[::-1], device)[::-1]
    part = _batch(some[::2], device)
    compared = [*zip(whole, turned, strict=True), *zip(whole[::2], part, strict=True)]
    same = sum(_same_bits(a, b) for a, b in compared)
    boxes = [one.detection for one in some]
    apart = [
        _apart(a.result, b.result, box)
        for (a, b), box in zip(compared, [*boxes, *boxes[::2]], strict=True)
        if a.result is not None and b.result is not None
    ]
    row = [str(len(compared)), str(same), f"{max(apart, default=0.0):.1e}"]
    return Section(title, head, [row], ["The same batch backwards, and every other pair of it."], same == len(compared))


def correctness(pairs: Sequence[Pair], device: torch.device, seeds: int, deadline: Deadline) -> Section:
    """Each pair on the CPU, on the device, and on the device in a batch."""
    rows, met, left_out = [], True, 0
    for seed in range(seeds):
        for pair in pairs:
            if deadline.left < 0:
                left_out += 1
                continue
            here = _registered(pair, torch.device("cpu"), seed)
            there = _registered(pair, device, seed)
            (one,) = _batch([pair], device, seed)
            batched = one.result if one.result is not None else one.error
            row, same = compared(pair, seed, here, [there, batched])
            rows.append(row)
            met &= same
    head = (
        "pair", "seed", "CPU", "device", "device, batch", "apart, diameters", "batch apart", "deviations apart",
        "the CPU's result",
    )  # fmt: skip
    notes = [
        f"Apart: the box's corners; {MOST_APART:g} diameters are allowed where the verdict is not a rejection. "
        "Deviations apart: relative difference of the pose's standard deviations, the largest of seven and of both; "
        f"{DEVIATIONS_APART:g} is allowed where the pose is the CPU's and the verdict is not a rejection."
    ]
    if left_out:
        notes.append(f"Left out for want of time: {left_out} of {seeds * len(pairs)} pairs.")
    return Section("Beside the CPU", head, rows, notes, met)


Outcome = RegistrationResult | RegnfError | None


def compared(pair: Pair, seed: int, here: Outcome, others: Sequence[Outcome]) -> tuple[list[str], bool]:
    """A row of the table, and whether both others are the CPU's result."""
    verdicts, apart, deviations, same = [_verdict(here)], [], [], True
    for other in others:
        verdicts.append(_verdict(other))
        same &= verdicts[-1] == verdicts[0]
        if isinstance(here, RegistrationResult) and isinstance(other, RegistrationResult):
            places = [other.T_object_scene, *(one.T_object_scene for one in other.alternatives)]
            distance = min(_apart(here, replace(other, T_object_scene=T), pair.detection) for T in places)
            same &= here.verdict == "rejected" or distance <= MOST_APART
            apart.append(f"{distance:.1e}")
            if here.verdict != "rejected" and _apart(here, other, pair.detection) <= MOST_APART:
                deviations.append(_deviations_apart(here, other))
        else:
            apart.append("-")
    same &= max(deviations, default=0.0) <= DEVIATIONS_APART
    largest = f"{max(deviations):.1e}" if deviations else "-"
    return [pair.name, str(seed), *verdicts, *apart, largest, "yes" if same else "NO"], same


def _verdict(one: Outcome) -> str:
    if isinstance(one, RegistrationResult):
        return one.verdict
    return one.reason if one is not None else "-"


def _apart(one: RegistrationResult, other: RegistrationResult, box: Any) -> float:
    """Largest distance between the places of the box's corners, object diameters."""
    corners = box.corners()
    moved = one.T_object_scene.apply(corners) - other.T_object_scene.apply(corners)
    return float(moved.norm(dim=-1).max()) / one.metrics["object_diameter"]


def _deviations_apart(one: RegistrationResult, other: RegistrationResult) -> float:
    """Largest relative difference of the standard deviations; 0 where neither result has a covariance."""
    if one.covariance is None or other.covariance is None:
        return 0.0 if one.covariance is other.covariance else float("inf")
    ratio = (other.covariance.diagonal() / one.covariance.diagonal()).sqrt()
    return float((ratio - 1.0).abs().max())


def _same_bits(one: BatchOutcome, other: BatchOutcome) -> bool:
    a, b = one.result, other.result
    if a is None or b is None:
        return a is b and one.error is not None and other.error is not None and one.error.reason == other.error.reason
    return a.verdict == b.verdict and torch.equal(a.T_object_scene.matrix(), b.T_object_scene.matrix())


def _right(pairs: Sequence[Pair]) -> list[Pair]:
    """The right pairs of the first room."""
    return [pair for pair in pairs if pair.right and pair.room == pairs[0].room]


def _registered(pair: Pair, device: torch.device, seed: int) -> RegistrationResult | RegnfError:
    scene, obj = (field_at(path, str(device)) for path in (pair.room, pair.object))
    model = model_at(pair.object, str(device))
    try:
        return register(scene, obj, pair.detection, ALONE, seed, object_model=model, clouds=False)
    except RegnfError as error:
        return error


def _batch(pairs: Sequence[Pair], device: torch.device, seed: int = 0) -> list[BatchOutcome]:
    """The pairs, all of one room, in one batch."""
    paths = list(dict.fromkeys(pair.object for pair in pairs))
    objects = [ModeledObject(field_at(path, str(device)), model_at(path, str(device))) for path in paths]
    numbers = [(number, paths.index(pair.object)) for number, pair in enumerate(pairs)]
    scene, boxes = field_at(pairs[0].room, str(device)), [pair.detection for pair in pairs]
    return register_batch(scene, boxes, objects, numbers, ALONE, seed=seed, clouds=False)


def _median_seconds(task: Any, repeats: int) -> float:
    found = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        value, _ = task()
        float(value[0])  # waits for the device
        found.append(time.perf_counter() - begun)
    return statistics.median(found[1:])


def _reset_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def _peak(device: torch.device) -> str:
    return f"{torch.cuda.max_memory_allocated(device) / 2**20:.0f}" if device.type == "cuda" else "-"
