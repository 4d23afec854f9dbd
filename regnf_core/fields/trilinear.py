"""Trilinear interpolation from a cell's eight corners, and its derivative."""

from __future__ import annotations

import torch
from torch import Tensor


def interpolate(corners: Tensor, weights: Tensor) -> Tensor:
    """The value (N, ...) within the cell, from the corners' (2, 2, 2, N, ...), x first.

    weights: (3, N, ...), the share of the upper corner along x, y and z; its trailing axes broadcast.
    """
    for weight in weights:
        corners = torch.lerp(corners[0], corners[1], weight)
    return corners


def interpolate_with_derivative(corners: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`interpolate`, and its derivative (3, N, ...) by the weights."""
    derivatives: list[Tensor] = []
    for weight in weights:
        derivatives = [torch.lerp(d[0], d[1], weight) for d in derivatives]
        derivatives.append(corners[1] - corners[0])
        corners = torch.lerp(corners[0], corners[1], weight)
    return corners, torch.stack(derivatives)


def interpolate_colors(corners: Tensor, weights: Tensor) -> Tensor:
    """Color (N, 3) within the cell from the corners' (8, N, 3), as :func:`interpolate`; black where none has one.

    A corner with a negative number has no color, and the others count.
    """
    corners = corners.float()
    known = (corners >= 0.0).all(-1, keepdim=True)
    corners = torch.cat((torch.where(known, corners, 0.0), known), dim=-1)
    mixed = interpolate(corners.view(2, 2, 2, -1, 4), weights[..., None])
    return (mixed[:, :3] / mixed[:, 3:].clamp_min(1e-9)).clamp(0.0, 1.0)


def corner_offsets(device: torch.device) -> Tensor:
    """(8, 3) int64: the corners of a cell, z fastest, in the order that :func:`interpolate` wants them."""
    pair = torch.arange(2, device=device)
    return torch.cartesian_prod(pair, pair, pair)
