"""Gaussian splats as arrays, whatever file they came from; moved by a similarity; written as the trainers' PLY."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.rotations import rotation_rows

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
SH_DC = 0.28209479177387814
"""The spherical harmonic of degree 0: a color is 0.5 + SH_DC times its coefficient."""
MAX_SPLATS = 20_000_000
_THIN = -20.0
"""Logarithm of the thickness of surfels (2D Gaussians), which have only two scales, in the file's unit."""
_OPACITY = 1e-6
"""Opacities are kept so far from 0 and 1: their logits are finite."""


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians. means: (N, 3), the file's frame and unit · scales: (N, 3), natural logarithms of the standard
    deviations along the own axes · rotations: (N, 4), unit quaternions w x y z, from the own axes to the frame ·
    opacities: (N,) in [0, 1] · harmonics: (N, K, 3), coefficients of K = 1, 4, 9 or 16 spherical harmonics for R, G, B,
    as in the 3DGS paper (Kerbl et al. 2023) · flat: whether they are surfels, of two scales.
    """

    means: Doubles
    scales: Floats
    rotations: Floats
    opacities: Floats
    harmonics: Floats
    flat: bool = False

    def __len__(self) -> int:
        return len(self.means)

    @property
    def colors(self) -> Floats:
        """(N, 3) in [0, 1], sRGB: what is the same in every direction."""
        colors: Floats = np.clip(0.5 + np.float32(SH_DC) * self.harmonics[:, 0], 0.0, 1.0)
        return colors

    def chosen(self, which: npt.NDArray[Any]) -> Splats:
        """Those of a mask or of indices."""
        means, scales, rotations = self.means[which], self.scales[which], self.rotations[which]
        return Splats(means, scales, rotations, self.opacities[which], self.harmonics[which], self.flat)

    @classmethod
    def together(cls, parts: Sequence[Splats]) -> Splats:
        """All of them, with as many harmonics as each has."""
        terms = min(part.harmonics.shape[1] for part in parts)
        return cls(
            np.concatenate([part.means for part in parts]),
            np.concatenate([part.scales for part in parts]),
            np.concatenate([part.rotations for part in parts]),
            np.concatenate([part.opacities for part in parts]),
            np.concatenate([part.harmonics[:, :terms] for part in parts]),
            all(part.flat for part in parts),
        )

    def axes(self) -> Floats:
        """(N, 3, 3): rotation matrices, the own axes as columns."""
        w, x, y, z = self.rotations.T
        return np.ascontiguousarray(np.array(rotation_rows(x, y, z, w)).transpose(2, 0, 1))

    def moved(self, transform: Doubles) -> Splats:
        """The same splats in another frame. transform: (4, 4), a similarity from this frame to the other."""
        from scipy.spatial.transform import Rotation

        scale = float(np.cbrt(np.linalg.det(transform[:3, :3])))
        turn = transform[:3, :3] / scale
        w, x, y, z = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
        ow, ox, oy, oz = self.rotations.T
        turned = [
            w * ow - x * ox - y * oy - z * oz,
            w * ox + x * ow + y * oz - z * oy,
            w * oy - x * oz + y * ow + z * ox,
            w * oz + x * oy - y * ox + z * ow,
        ]
        return replace(
            self,
            means=self.means @ transform[:3, :3].T + transform[:3, 3],
            scales=(self.scales + np.float32(np.log(scale))).astype(np.float32),
            rotations=np.stack(turned, axis=1).astype(np.float32),
            harmonics=turned_harmonics(self.harmonics, turn),
        )


def sound(splats: Splats) -> tuple[Splats, int]:
    """The splats whose numbers are finite and whose quaternions are not zero, these of unit length; and how many were
    left out. Raises FieldFormatError (MESH_INVALID) where none is left."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(splats.rotations, axis=1)
        kept = np.isfinite(splats.means).all(axis=1) & np.isfinite(splats.scales).all(axis=1)
        kept &= np.isfinite(splats.opacities) & np.isfinite(splats.harmonics[:, 0]).all(axis=1)
        kept &= np.isfinite(length) & (length > 0.0)
    lost = int(len(kept) - kept.sum())
    if lost == len(kept):
        raise FieldFormatError("the file has no Gaussian with finite numbers", reason="MESH_INVALID")
    left = splats if lost == 0 else splats.chosen(kept)
    return replace(left, rotations=left.rotations / length[kept][:, None]), lost


def basis(directions: Doubles, terms: int) -> Doubles:
    """(N, terms): the real spherical harmonics of unit vectors (N, 3), with the signs of 3DGS and of the extension
    KHR_gaussian_splatting. terms: 1, 4, 9 or 16."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    one = np.full_like(x, SH_DC)
    first = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    second = [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
    ]
    third = [
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack([one, *first, *second, *third][:terms], axis=1)


def turned_harmonics(harmonics: Floats, turn: Doubles) -> Floats:
    """(N, K, 3): the coefficients of colors that turn with the frame. turn: (3, 3), from the old frame to the new.

    The new color in a direction is the old one in the direction turned back. Both are expanded in the same functions,
    and each degree has a matrix of its own, which many directions determine.
    """
    terms = harmonics.shape[1]
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    matrix = np.linalg.lstsq(basis(directions, terms), basis(directions @ turn, terms), rcond=None)[0]
    turned: Floats = np.einsum("ij,njc->nic", matrix.astype(np.float32), harmonics, optimize=True)
    return turned


def write_ply(splats: Splats) -> bytes:
    """The splats as a binary PLY file with the properties of the 3DGS trainer."""
    count, terms = len(splats), splats.harmonics.shape[1]
    opacity = np.clip(splats.opacities.astype(np.float64), _OPACITY, 1.0 - _OPACITY)
    columns: dict[str, npt.NDArray[Any]] = {name: splats.means[:, axis] for axis, name in enumerate("xyz")}
    columns |= {f"f_dc_{channel}": splats.harmonics[:, 0, channel] for channel in range(3)}
    rest = splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (terms - 1))  # all of R, then G, then B
    columns |= {f"f_rest_{number}": rest[:, number] for number in range(rest.shape[1])}
    columns["opacity"] = np.log(opacity / (1.0 - opacity))
    columns |= {f"scale_{axis}": splats.scales[:, axis] for axis in range(2 if splats.flat else 3)}
    columns |= {f"rot_{part}": splats.rotations[:, part] for part in range(4)}
    rows = np.empty(count, [(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in columns]
    return "\n".join([*header, "end_header", ""]).encode() + rows.tobytes()


def sigmoid(logits: npt.NDArray[Any]) -> Floats:
    """1 / (1 + exp(-x)), without overflow."""
    from scipy.special import expit

    return np.asarray(expit(np.asarray(logits, np.float32)), np.float32)


def with_third_scale(scales: npt.NDArray[Any]) -> tuple[Floats, bool]:
    """Three scales of two or three, and whether they were two."""
    flat = scales.shape[1] == 2
    if flat:
        scales = np.column_stack([scales, np.full(len(scales), _THIN)])
    return np.ascontiguousarray(scales, np.float32), flat


def smallest_three(largest: npt.NDArray[np.int64], others: Doubles) -> Floats:
    """(N, 4) w x y z. largest: (N,), which of w x y z is left out · others: (N, 3), the rest in that order."""
    whole = np.sqrt(np.clip(1.0 - (others**2).sum(axis=1), 0.0, None))
    found = np.empty((len(others), 4), np.float32)
    for left_out in range(4):
        chosen = largest == left_out
        rest = [part for part in range(4) if part != left_out]
        found[chosen, left_out] = whole[chosen]
        found[np.ix_(chosen, rest)] = others[chosen]
    return found
