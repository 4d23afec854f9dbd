"""Similarity transforms: one scale, one rotation, one translation, x -> s R x + t."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.geometry.bundle import Bundle, over_tensors
from regnf_core.geometry.exponential_map import (
    exp_parts,
    log_parts,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
    split_tangent,
)

_SIMILARITY_TOLERANCE = 1e-4  # float32 matrices from other tools come with about 1e-6


def _invalid(message: str) -> InvalidInputError:
    return InvalidInputError(message, reason="INVALID_TRANSFORM")


def _numbers(values: Any) -> Tensor:
    """Values as float64, where they are numbers in a regular array."""
    try:
        return torch.as_tensor(values, dtype=torch.float64)
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise _invalid("a transform must consist of numbers, in rows of equal length") from error


@dataclass(frozen=True, eq=False)
class Sim3(Bundle):
    """A similarity transform, or a batch of them: x -> scale * rotation @ x + translation.

    scale: (...) > 0 · rotation: (..., 3, 3) proper · translation: (..., 3). float64 unless made otherwise.
    Products read like the paper's: ``(T_c_b @ T_b_a)`` maps frame a to frame c. Autograd flows through everything.
    A batch is indexed like a tensor: ``T[i]``, ``T[mask]``, and ``T[None]`` makes a batch of one transform.
    """

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    @classmethod
    def identity(cls, dtype: torch.dtype = torch.float64) -> Sim3:
        """The transform that changes nothing."""
        return cls(torch.ones((), dtype=dtype), torch.eye(3, dtype=dtype), torch.zeros(3, dtype=dtype))

    @classmethod
    def from_translation(cls, translation: Tensor) -> Sim3:
        """A pure shift by ``translation`` (..., 3)."""
        eye = torch.eye(3, dtype=translation.dtype, device=translation.device)
        return cls(torch.ones_like(translation[..., 0]), eye.expand(*translation.shape[:-1], 3, 3).clone(), translation)

    @classmethod
    def from_matrix(cls, matrix: Tensor | Sequence[Sequence[float]]) -> Sim3:
        """From (..., 4, 4) homogeneous matrices.

        Raises InvalidInputError (INVALID_TRANSFORM) unless each is a similarity: finite, last row (0, 0, 0, 1),
        equal singular values, no reflection.
        """
        M = _numbers(matrix)
        if M.shape[-2:] != (4, 4):
            raise _invalid(f"a transform is a 4x4 matrix, not {tuple(M.shape)}")
        if not torch.isfinite(M).all():
            raise _invalid("the transform holds a number that is not finite")
        last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=M.dtype, device=M.device)
        if not torch.allclose(M[..., 3, :], last_row.expand_as(M[..., 3, :]), atol=1e-9):
            raise _invalid("the transform's last row is not (0, 0, 0, 1)")
        U, singular, Vh = torch.linalg.svd(M[..., :3, :3])
        scale = singular.mean(-1)
        spread = (singular[..., 0] - singular[..., 2]) / scale.clamp_min(1e-300)
        if not ((scale > 1e-12) & (spread <= _SIMILARITY_TOLERANCE)).all():
            raise _invalid("the transform is not a similarity: its axes have different lengths, or length 0")
        rotation = U @ Vh  # nearest rotation
        if not (torch.linalg.det(rotation) > 0).all():
            raise _invalid("the transform is a reflection")
        return cls(scale, rotation, M[..., :3, 3].clone())

    @classmethod
    def from_quaternion(
        cls,
        scale: Tensor | float,
        rotation_quaternion_xyzw: Tensor | Sequence[float],
        translation: Tensor | Sequence[float],
    ) -> Sim3:
        """From scale (...), quaternion (..., 4) as (x, y, z, w), normalized here, and translation (..., 3)."""
        s, q, t = _numbers(scale), _numbers(rotation_quaternion_xyzw), _numbers(translation)
        if q.shape[-1:] != (4,) or t.shape[-1:] != (3,):
            raise _invalid("a quaternion needs four numbers, and a translation three")
        if not all(torch.isfinite(part).all() for part in (s, q, t)):
            raise _invalid("the transform holds a number that is not finite")
        norm = q.norm(dim=-1, keepdim=True)
        if not ((s > 0).all() and (norm > 1e-9).all()):
            raise _invalid("the scale must be positive, and the quaternion must not be zero")
        return cls(s, matrix_from_quaternion(q / norm), t)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Sim3:
        """From what :meth:`to_dict` gives: ``matrix`` alone, or scale, quaternion and translation."""
        if "matrix" in values:
            return cls.from_matrix(values["matrix"])
        try:
            return cls.from_quaternion(values["scale"], values["rotation_quaternion_xyzw"], values["translation"])
        except KeyError as error:
            raise _invalid(f"the transform has no {error.args[0]!r}") from error

    @classmethod
    def exp(cls, tangent: Tensor) -> Sim3:
        """The exponential of (..., 7): rotation omega (3, radians), translation part rho (3), log scale (1)."""
        return cls(*exp_parts(tangent))

    @classmethod
    def cat(cls, parts: Sequence[Sim3]) -> Sim3:
        """All transforms of several batches or single transforms, one after the other: a batch (H,), H >= 0."""
        if not parts:
            return cls.identity()[None][:0]
        return cls(
            torch.cat([T.scale.reshape(-1) for T in parts]),
            torch.cat([T.rotation.reshape(-1, 3, 3) for T in parts]),
            torch.cat([T.translation.reshape(-1, 3) for T in parts]),
        )

    @classmethod
    def where(cls, mask: Tensor, first: Sim3, second: Sim3) -> Sim3:
        """Batches of equal shape: ``first`` where ``mask`` (...) is True, else ``second``."""
        return cls(
            torch.where(mask, first.scale, second.scale),
            torch.where(mask[..., None, None], first.rotation, second.rotation),
            torch.where(mask[..., None], first.translation, second.translation),
        )

    def __repr__(self) -> str:
        if self.scale.ndim:
            return f"Sim3({len(self)} transforms)"
        place = ", ".join(f"{value:.4g}" for value in self.translation.tolist())
        turn = ", ".join(f"{value:.4g}" for value in self.quaternion_xyzw().tolist())
        return f"Sim3(scale {float(self.scale):.4g}, quaternion xyzw [{turn}], translation [{place}])"

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray[Any, Any]:
        """(..., 4, 4) homogeneous matrices, for NumPy."""
        return np.array(self.matrix().detach().cpu().numpy(), dtype=dtype)

    def __len__(self) -> int:
        """How many transforms a batch holds."""
        return len(self.scale)

    def __iter__(self) -> Iterator[Sim3]:
        return (self[i] for i in range(len(self)))

    def expand(self, count: int) -> Sim3:
        """One transform ``count`` times, as a batch."""
        found: Sim3 = over_tensors(lambda part: part.expand(count, *part.shape), self)
        return found

    def log(self) -> Tensor:
        """The tangent (..., 7) whose :meth:`exp` is this transform; its rotation angle is at most pi."""
        return log_parts(self.scale, self.rotation, self.translation)

    def perturb(self, step: Tensor) -> Sim3:
        """s e^sigma, exp(omega) R, t + dt for steps (..., 7) = (omega, dt, sigma).

        A left perturbation that pivots on t: the rotation and the scale leave the translation as it is. It agrees with
        ``Sim3.exp(step) @ T`` to first order where t = 0.
        """
        omega, dt, sigma = split_tangent(step)
        return Sim3(self.scale * sigma.exp(), rotation_exp(omega) @ self.rotation, self.translation + dt)

    def __matmul__(self, other: Sim3) -> Sim3:
        """The transform that applies ``other`` first."""
        return Sim3(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.scale.unsqueeze(-1) * (self.rotation @ other.translation.unsqueeze(-1)).squeeze(-1) + self.translation,
        )

    def inverse(self) -> Sim3:
        """The transform back."""
        scale = 1.0 / self.scale
        rotation = self.rotation.mT
        shift = (rotation @ self.translation.unsqueeze(-1)).squeeze(-1)
        return Sim3(scale, rotation, -scale.unsqueeze(-1) * shift)

    def apply(self, points: Tensor) -> Tensor:
        """Points (..., N, 3) in the target frame; dtype and device of the points."""
        T = self.to(points)
        return T.scale[..., None, None] * (points @ T.rotation.mT) + T.translation[..., None, :]

    def apply_inverse(self, points: Tensor) -> Tensor:
        """``inverse().apply(points)`` in a third of the operations."""
        T = self.to(points)
        return (points - T.translation[..., None, :]) @ T.rotation / T.scale[..., None, None]

    def matrix(self) -> Tensor:
        """(..., 4, 4) homogeneous matrices."""
        M = self.scale.new_zeros(*self.scale.shape, 4, 4)
        M[..., :3, :3] = self.scale[..., None, None] * self.rotation
        M[..., :3, 3] = self.translation
        M[..., 3, 3] = 1.0
        return M

    def quaternion_xyzw(self) -> Tensor:
        """(..., 4) unit quaternions (x, y, z, w) with w >= 0."""
        return quaternion_from_matrix(self.rotation)

    def to(self, like: Tensor) -> Sim3:
        """The same transform in the dtype and on the device of another tensor."""
        return Sim3(self.scale.to(like), self.rotation.to(like), self.translation.to(like))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values: ``matrix`` (row-major 4x4), ``scale``, ``rotation_quaternion_xyzw``, ``translation``."""
        return {
            "matrix": self.matrix().tolist(),
            "scale": self.scale.tolist(),
            "rotation_quaternion_xyzw": self.quaternion_xyzw().tolist(),
            "translation": self.translation.tolist(),
        }
