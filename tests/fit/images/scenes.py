"""Posed images of a ball and a box whose distance is known, by sphere tracing: no renderer of ours is involved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from regnf_data.posed_images import PosedImages

Floats = NDArray[np.float64]

BALL_CENTER, BALL_RADIUS = np.array([0.25, 0.0, 0.0]), 0.25
BOX_CENTER, BOX_HALF = np.array([-0.3, 0.0, 0.0]), np.array([0.15, 0.2, 0.25])
BOUNDS = np.array([[-0.6, -0.4, -0.4], [0.6, 0.4, 0.4]])
SIZE = float(np.linalg.norm(BOUNDS[1] - BOUNDS[0]))


def ball_distance(points: Floats) -> Floats:
    """(N,) of the ball alone."""
    distance: Floats = np.linalg.norm(points - BALL_CENTER, axis=-1) - BALL_RADIUS
    return distance


def distance(points: Floats) -> Floats:
    """(N,) of ball and box."""
    beyond = np.abs(points - BOX_CENTER) - BOX_HALF
    box = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)
    return np.minimum(ball_distance(points), box)


def images(
    count: int = 8, height: int = 36, width: int = 48, ball_alone: bool = False, away: float = 1.0
) -> PosedImages:
    """Views from all sides, with exact depths; the color tells the place. From ``away`` times as far, the lens is as
    many times as long."""
    measured = ball_distance if ball_alone else distance
    steps = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * steps / count), np.pi * (1.0 + 5.0**0.5) * steps
    outwards = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    focal = 0.9 * width * away
    camera = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
    rows, columns = np.indices((height, width)) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera).T
    poses, depths, colors = [], [], []
    for outward in outwards:
        pose = _looking_back(1.6 * away * outward)
        directions = rays @ pose[:3, :3].T
        depth = _traced(measured, pose[:3, 3], directions, 5.0 * away)
        points = pose[:3, 3] + depth[..., None] * directions
        shade = np.clip(0.5 + 0.8 * (points - BALL_CENTER), 0.0, 1.0)
        poses.append(pose)
        depths.append(depth)
        colors.append(np.where(depth[..., None] > 0.0, np.round(255.0 * shade), 0.0))
    stacked = np.stack(depths).astype(np.float32)
    return PosedImages(
        colors=np.stack(colors).astype(np.uint8),
        intrinsics=np.tile(camera, (count, 1, 1)),
        T_world_camera=np.stack(poses),
        bounds=BOUNDS,
        depths=stacked,
        masks=stacked > 0.0,
    )


def _looking_back(position: Floats) -> Floats:
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.6, 0.8])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    pose[:3, 3] = position
    return pose


def _traced(measured, origin: Floats, directions: Floats, farthest: float) -> Floats:  # type: ignore[no-untyped-def]
    depth = np.zeros(directions.shape[:2])
    speed = np.linalg.norm(directions, axis=-1)
    for _ in range(100):
        depth += measured(origin + depth[..., None] * directions) / speed
    return np.where(depth < farthest, depth, 0.0)
