"""nerf2nerf (Goli et al., ICRA 2023, arXiv 2211.01600), written from its description and that in the Reg-NF paper.

    L(T) = E_{x in A} kappa(S_b(T x) - S_a(x)) + lambda(k) mean_i |T p_i - q_i|^2

T is rigid: the method assumes that both fields have one scale. A are samples of the scene a, (p_i, q_i) keypoints that
a person marked in both fields, kappa Barron's adaptive robust kernel with learned shape and scale, lambda cooled by
half a cosine from one to nothing. Adam takes 10,000 steps over the six degrees of freedom.

Adapted: the authors' surface field is the likelihood, drawn from a NeRF's density, that a point lies on a surface. Here
S is the signed distance, as in the Reg-NF paper's own comparison, which gave nerf2nerf "the same surface fields from
our SDF models" and changed only the sampling "to suit SDF notation, where a surface has a value of zero".

Chosen here, since neither description at hand settles it:
- Keypoints: 5, as far apart as the scene's samples allow; noise of 1 % of the diameter on every coordinate. They are
  points of the object's own surface or of what else stands in the box, marked exactly on the scene's side.
- Start: the rigid least-squares fit of the keypoints.
- Samples: 1000, at first drawn from the shared surface points. Every 10 steps each takes one Metropolis-Hastings step:
  a Gaussian proposal (2 % of the diameter), stationary density exp(-(S_a(x) / 1 %)^2 / 2 - (S_b(T x) / 5 %)^2 / 2),
  in diameters: on the scene's surface, and near the object's under the current transform.
- Adam's rate: 0.005 (radians; diameters for the translation), cooled by the same half cosine. The kernel learns at
  0.005 throughout.
- The rotation is a rotation vector applied on the left about the middle of the object's samples.
Most of these flatter the method: its samples begin on the whole surface, its keypoints are no guesses, its last steps
are small ones.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.peers.disturbance import keypoints, rigid_fit
from benchmarks.peers.interface import PeerCase, PeerResult
from regnf_core import SdfField, Sim3
from regnf_core.fields.observation import CountingField, differentiable_signed_distance
from regnf_core.geometry.exponential_map import rotation_exp
from regnf_core.paper.optimization import AdaptiveKernel

STEPS = 10_000
_KEYPOINTS, _KEYPOINT_NOISE = 5, 0.01  # noise in diameters
_SAMPLES, _EVERY = 1000, 10
_PROPOSAL, _NEAR_SCENE, _NEAR_OBJECT = 0.02, 0.01, 0.05  # diameters
_RATE, _KERNEL_RATE = 0.005, 0.005


@dataclass(frozen=True)
class Nerf2nerf:
    """The method with its published number of steps. stop_below: mean |residual|, diameters, at which to stop early;
    the published method, and so the default, never does.
    """

    steps: int = STEPS
    stop_below: float | None = None
    uses_samples: bool = True

    @property
    def name(self) -> str:
        return "nerf2nerf" if self.steps == STEPS else f"nerf2nerf ({self.steps} steps)"

    @property
    def given(self) -> str:
        return f"{_KEYPOINTS} true keypoints, {100 * _KEYPOINT_NOISE:.0f} % noise"

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """Raises InvalidInputError (FIELD_NOT_FINITE) where the fields do."""
        begun, processor = time.perf_counter(), time.process_time()
        run = _Run(case, seed)
        taken = 0
        for step in range(self.steps):
            cooling = 0.5 * (1.0 + math.cos(math.pi * step / self.steps))
            error = run.step(step, cooling)
            taken = step + 1
            if self.stop_below is not None and error < self.stop_below * case.diameter:
                break
        seconds = time.perf_counter() - begun
        each = 1000 * (time.process_time() - processor) / taken
        note = f"{taken} steps, {each:.1f} ms of processor time each"
        return PeerResult(run.transform(), seconds, run.evaluations, note)


class RigidMotion:
    """T_object_scene without scale, as six numbers about a start: float64 leaves for the optimizer.

    T x = exp(turn) (T_start x - center) + center + unit * shift; turn (3,) radians, shift (3,) in ``unit``s.
    """

    def __init__(self, start: Sim3, center: Tensor, unit: float) -> None:
        self.start, self.center, self.unit = start, center.double(), unit
        self.turn = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        self.shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    def transform(self) -> Sim3:
        """The transform; differentiable in ``turn`` and ``shift``."""
        R = rotation_exp(self.turn)
        offset = R @ (self.start.translation - self.center) + self.center + self.unit * self.shift
        return Sim3(self.start.scale, R @ self.start.rotation, offset)


def one_way_residuals(points: Tensor, own_distance: Tensor, obj: SdfField, T_object_scene: Sim3) -> Tensor:
    """S_b(T x) - S_a(x), (N,), at scene points (N, 3) whose S_a (N,) is known. Differentiable in the transform."""
    return differentiable_signed_distance(obj, T_object_scene.apply(points)) - own_distance


class _Run:
    """One optimization: the motion, the kernel, the samples, and Adam's state."""

    def __init__(self, case: PeerCase, seed: int) -> None:
        self.scene, self.obj = CountingField(case.scene), CountingField(case.obj)
        self.diameter = case.diameter
        self.generator = torch.Generator().manual_seed(seed)
        noise = _KEYPOINT_NOISE * case.diameter
        self.marked = keypoints(case.scene_samples.points, case.truth, _KEYPOINTS, noise, seed)
        center = case.object_samples.points.double().mean(0)
        self.motion = RigidMotion(rigid_fit(*self.marked), center, case.diameter)
        self.kernel = AdaptiveKernel()
        self.samples = case.scene_samples.subsample(_SAMPLES, self.generator).points
        self.own_distance = self.scene.signed_distance(self.samples)
        pose = {"params": [self.motion.turn, self.motion.shift], "lr": _RATE}
        self.adam = torch.optim.Adam([pose, {"params": [self.kernel.latents], "lr": _KERNEL_RATE}])

    @property
    def evaluations(self) -> int:
        return self.scene.evaluations + self.obj.evaluations

    def transform(self) -> Sim3:
        """The motion now, without a graph."""
        with torch.no_grad():
            return self.motion.transform()

    def step(self, number: int, cooling: float) -> float:
        """One step of Adam, after a step of the samples when it is time. Returns the mean |residual|, object units."""
        if number and number % _EVERY == 0:
            self._move_samples()
        T = self.motion.transform()
        residuals = one_way_residuals(self.samples, self.own_distance, self.obj, T) / self.diameter
        in_scene, in_object = self.marked
        marked = ((T.apply(in_scene) - in_object) / self.diameter).square().sum(-1).mean()
        loss = self.kernel.negative_log_likelihood((residuals,)) + cooling * marked
        self.adam.param_groups[0]["lr"] = _RATE * cooling
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        return self.diameter * float(residuals.detach().abs().mean())

    def _move_samples(self) -> None:
        """One Metropolis-Hastings step of every sample."""
        T = self.transform()
        shake = torch.randn(self.samples.shape, generator=self.generator).to(self.samples)
        proposed = self.samples + _PROPOSAL * self.diameter * shake
        distance = self.scene.signed_distance(proposed)
        gain = self._log_density(distance, self.obj.signed_distance(T.apply(proposed)))
        gain -= self._log_density(self.own_distance, self.obj.signed_distance(T.apply(self.samples)))
        taken = torch.rand(len(gain), generator=self.generator).log().to(gain) < gain
        self.samples = torch.where(taken[:, None], proposed, self.samples)
        self.own_distance = torch.where(taken, distance, self.own_distance)

    def _log_density(self, in_scene: Tensor, in_object: Tensor) -> Tensor:
        near_scene, near_object = _NEAR_SCENE * self.diameter, _NEAR_OBJECT * self.diameter
        return -0.5 * ((in_scene / near_scene).square() + (in_object / near_object).square())
