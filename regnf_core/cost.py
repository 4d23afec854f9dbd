"""What the options of a registration cost at most: memory and seconds, estimated before any field is opened.

Single options have ranges; what exhausts a machine is their products. One term stands for each product. The unit costs
were measured on one core with the neural fields of examples/data (benchmarks/option_extremes.py repeats the memory).
They are upper ends for memory. Seconds differ from field to field by a factor of ten either way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from regnf_core.options import RegistrationOptions

MIB = 1 << 20
BASE_BYTES = 640 * MIB
"""Of the engine's libraries and what every registration needs."""
_BASE_S = 2.0
_SIDES = 2
"""Scene and object."""

# Bytes and seconds for one unit of each product.
_RAY_BYTES, _RAY_S = 700, 40e-6
"""A ray of one field that finds surface: its point, normal and descriptor, and what is written and drawn of it. The
seconds include the quarter of the rays that the verification casts again."""
_STEP_S = 18e-6
"""A sample in an iteration: distance and gradient in one field."""
_SAMPLE_BYTES = 800
_RESAMPLE_S = 40e-6
_DRAW_S = 5e-6
"""A draw of RANSAC."""
_ROTATION_S = 0.25e-3
_MATCH_S = 0.15
"""A feature match of the preset `robust`."""
_SURFACE_SAMPLE_BYTES, _SURFACE_SAMPLE_S = 12_000, 60e-6
_MOST_SURFACE_SAMPLES = 46_656
"""Cells of the finest grid that samples are taken from: there are no more samples, whatever the option says."""
_MODEL_BYTES, _MODEL_S = 64, 1.5
"""Of a library's object: bytes for each of its samples."""

Option = tuple[str, ...]


@dataclass(frozen=True)
class Term:
    """A product of options: what it counts, how many there are, the options that it is made of, and what it costs."""

    counts: str
    count: int
    options: tuple[Option, ...]
    memory_bytes: int
    seconds: float


@dataclass(frozen=True)
class Cost:
    """The estimated cost of one registration, or of one search among several objects."""

    terms: tuple[Term, ...]

    @property
    def memory_bytes(self) -> int:
        return BASE_BYTES + sum(term.memory_bytes for term in self.terms)

    @property
    def seconds(self) -> float:
        return _BASE_S + sum(term.seconds for term in self.terms)

    def largest(self, of: Literal["memory_bytes", "seconds"]) -> Term:
        return max(self.terms, key=lambda term: float(getattr(term, of)))


def estimate(options: RegistrationOptions, objects: int = 1) -> Cost:
    """The cost by the options, for one object or for a search among ``objects`` of them."""
    return Cost(_of_paper(options) if options.preset == "paper" else _of_robust(options, objects))


def ray_count(options: RegistrationOptions) -> int:
    """Rays that the preset `paper` casts at each of the two fields."""
    one = options.sampling
    return one.views * max(1, one.image_size // one.pixel_stride) ** 2


def _term(counts: str, count: int, options: str, memory_bytes: int = 0, seconds: float = 0.0) -> Term:
    """options: their paths, with blanks between them."""
    paths = tuple(tuple(path.split(".")) for path in options.split())
    return Term(counts, count, paths, memory_bytes, seconds)


def _of_paper(options: RegistrationOptions) -> tuple[Term, ...]:
    start, steps, again = options.initialization, options.optimization, options.resampling
    rays = ray_count(options)
    draws = start.draws * start.ransac_iterations
    samples = min(steps.samples_per_iteration, again.max_samples)
    taken = steps.iterations * samples
    resampled = steps.iterations // again.every * again.max_samples
    of_rays = "sampling.views sampling.image_size sampling.pixel_stride"
    of_draws = "initialization.draws initialization.ransac_iterations"
    of_steps = "optimization.iterations optimization.samples_per_iteration"
    of_resampling = "optimization.iterations resampling.every resampling.max_samples"
    kept_bytes = _SIDES * again.max_samples * _SAMPLE_BYTES
    return (
        _term("rays", rays, of_rays, _SIDES * rays * _RAY_BYTES, _SIDES * rays * _RAY_S),
        _term("draws of RANSAC", draws, of_draws, 0, draws * _DRAW_S),
        _term("samples in all iterations", taken, of_steps, _SIDES * samples * _SAMPLE_BYTES, _SIDES * taken * _STEP_S),
        _term("samples in all resamplings", resampled, of_resampling, kept_bytes, _SIDES * resampled * _RESAMPLE_S),
    )


def _of_robust(options: RegistrationOptions, objects: int) -> tuple[Term, ...]:
    one = options.robust
    scene, obj = (min(limit, _MOST_SURFACE_SAMPLES) for limit in (one.scene_samples, one.object_samples))
    both, modeled = scene + obj, objects * obj
    of_both, of_modeled = "robust.scene_samples robust.object_samples", "robust.object_samples"
    return (
        _term("rotations", one.rotations, "robust.rotations", 0, one.rotations * _ROTATION_S),
        _term("feature matches", one.feature_draws, "robust.feature_draws", 0, one.feature_draws * _MATCH_S),
        _term("surface samples", both, of_both, both * _SURFACE_SAMPLE_BYTES, both * _SURFACE_SAMPLE_S),
        _term("samples of all objects", modeled, of_modeled, modeled * _MODEL_BYTES, objects * _MODEL_S),
    )
