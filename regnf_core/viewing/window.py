"""A window with a registration in 3D, where a display and PyVista or Open3D are there."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.result import RegistrationResult
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR

Cloud = tuple[NDArray[np.float64], tuple[float, float, float]]


def show(result: RegistrationResult) -> bool:
    """Open the window and return once it is closed; False where there can be none."""
    if not has_display():
        return False
    placed = result.object_samples.transformed(result.T_object_scene.inverse())
    clouds = [(_points(result.scene_samples), SCENE_COLOR), (_points(placed), OBJECT_COLOR)]
    for name, draw in (("pyvista", _with_pyvista), ("open3d", _with_open3d)):
        try:
            library = importlib.import_module(name)
        except ImportError:
            continue
        draw(library, clouds)
        return True
    return False


def has_display() -> bool:
    """Whether windows can be opened at all."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def _points(samples: SurfaceSamples) -> NDArray[np.float64]:
    points: NDArray[np.float64] = samples.points.double().cpu().numpy()
    return points


def _with_pyvista(pyvista: Any, clouds: list[Cloud]) -> None:
    plotter = pyvista.Plotter()
    for points, color in clouds:
        plotter.add_points(points, color=color)
    plotter.show()


def _with_open3d(open3d: Any, clouds: list[Cloud]) -> None:
    shown = []
    for points, color in clouds:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.paint_uniform_color(color)
        shown.append(cloud)
    open3d.visualization.draw_geometries(shown, window_name="regnf")
