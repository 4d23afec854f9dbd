"""preview.png: the object over the scene at the start and at the end, and the residuals of both surfaces."""

from __future__ import annotations

import importlib
import os
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from regnf_core.document import RegistrationResult
from regnf_core.geometry.metrics import gaps
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.surface.sphere_tracing import axis_vector
from regnf_core.viewing.splats import Floats, Surfels, nearest_surfels, paint_half, view_from

SCENE_COLOR = (0.38, 0.58, 0.80)
OBJECT_COLOR = (0.95, 0.56, 0.20)
_BACKGROUND = np.array([0.975, 0.975, 0.97])
_INK = (52, 56, 62)
_PANEL = 480
_CAPTION = 52
_ELEVATION = np.radians(28.0)
_RAMP_TOP = 0.015  # object diameters: largest residual of an inlier, by the defaults of both presets
_DISC_SHARE = 1.5  # disc radius over the typical gap of the cloud: closes the gaps
_RAMP = np.array(  # dark blue over teal to yellow: even in brightness, readable without telling red from green
    [[0.18, 0.20, 0.46], [0.19, 0.42, 0.56], [0.16, 0.62, 0.54], [0.53, 0.79, 0.34], [0.98, 0.88, 0.18]]
)


def registration_picture(result: RegistrationResult) -> Image.Image:
    """Three panels side by side: at the start, at the end, and the residuals of both surfaces. As the camera of the
    detection's image sees them, if there is one; else upright in the scene's frame."""
    scene = _surfels(result.scene_samples, SCENE_COLOR)
    start, end = (
        _surfels(result.object_samples.transformed(T_object_scene.inverse()), OBJECT_COLOR)
        for T_object_scene in (result.T_object_scene_initial, result.T_object_scene)
    )
    if result.camera is None:
        up = axis_vector(result.options["up_axis"] or "z").numpy()
        direction = _best_direction(scene, up)
    else:
        camera = result.camera.T_world_camera
        up, direction = -camera.rotation[:, 1].numpy(), camera.translation.numpy() - scene.points.mean(0)
    edge = 2 * _PANEL
    view = view_from(direction, up, np.concatenate([scene.points, start.points, end.points]), edge)
    radius = _DISC_SHARE * max(float(gaps(torch.from_numpy(cloud.points)).median()) for cloud in (scene, end))
    residual = Surfels.join(
        replace(scene, colors=residual_colors_of(result, "scene_residuals")),
        replace(end, colors=residual_colors_of(result, "object_residuals")),
    )
    before, after = Surfels.join(scene, start), Surfels.join(scene, end)
    in_front = nearest_surfels(after, view, edge, radius)
    panels = [
        paint_half(before, nearest_surfels(before, view, edge, radius), view, _BACKGROUND),
        paint_half(after, in_front, view, _BACKGROUND),
        paint_half(residual, in_front, view, _BACKGROUND),  # the same discs in other colors
    ]
    sheet = Image.new("RGB", (3 * _PANEL, _PANEL + _CAPTION), tuple(int(255 * part) for part in _BACKGROUND))
    for number, panel in enumerate(panels):
        sheet.paste(Image.fromarray(panel), (number * _PANEL, _CAPTION))
    _captions(sheet, result)
    return sheet


def residual_colors(shares: Floats) -> Floats:
    """(N, 3) colors of |residuals| (N,) given as a share of the ramp's top, clipped to it."""
    position = np.clip(shares, 0.0, 1.0) * (len(_RAMP) - 1)
    low = np.minimum(position.astype(np.int64), len(_RAMP) - 2)
    weight = (position - low)[:, None]
    colors: Floats = (1.0 - weight) * _RAMP[low] + weight * _RAMP[low + 1]
    return colors


def _surfels(samples: SurfaceSamples, color: tuple[float, float, float]) -> Surfels:
    points = samples.points.double().cpu().numpy()
    return Surfels(points, samples.normals.double().cpu().numpy(), np.broadcast_to(np.array(color), points.shape))


def residual_colors_of(result: RegistrationResult, name: str) -> Floats:
    """(N, 3) colors of the result's residuals of that name: ``scene_residuals`` or ``object_residuals``."""
    sizes = result.residuals[name].double().abs().cpu().numpy()
    return residual_colors(sizes / (_RAMP_TOP * result.metrics["object_diameter"]))


def _best_direction(scene: Surfels, up: Floats) -> Floats:
    """The direction to the viewer, (3,): from above, and from the side that shows most of the scene's surface."""
    first = np.roll(up, 1)
    second = np.cross(up, first)
    turns = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)[:, None]
    around = np.cos(turns) * first + np.sin(turns) * second
    candidates = np.cos(_ELEVATION) * around + np.sin(_ELEVATION) * up
    shown = np.clip(scene.normals @ candidates.T, 0.0, None).sum(0)
    best: Floats = candidates[int(shown.argmax())]
    return best


def _captions(sheet: Image.Image, result: RegistrationResult) -> None:
    draw = ImageDraw.Draw(sheet)
    title, small = ImageFont.load_default(size=20), ImageFont.load_default(size=14)
    scale = float(result.T_object_scene.scale)
    texts = [
        ("Start", "object (orange) over the scene (blue)"),
        (result.verdict.capitalize(), f"scale {scale:.4f}, after {int(result.metrics['iterations'])} iterations"),
        ("Residual", "|S_object(T x) - s S_scene(x)|"),
    ]
    for number, (heading, note) in enumerate(texts):
        left = number * _PANEL + 24
        draw.text((left, 16), heading, fill=_INK, font=title)
        draw.text((left, 42), note, fill=(120, 124, 130), font=small)
    width, height = 150, 10
    left, top = 3 * _PANEL - width - 24, 22
    ramp = residual_colors(np.linspace(0.0, 1.0, width))
    bar = np.broadcast_to((255 * ramp).astype(np.uint8), (height, width, 3))
    sheet.paste(Image.fromarray(np.ascontiguousarray(bar)), (left, top))
    draw.text((left, top + 20), "0", fill=_INK, font=small)
    draw.text((left + width, top + 20), f"{100 * _RAMP_TOP:g} % of diameter", fill=_INK, font=small, anchor="ra")


# A window with a registration in 3D, where a display and PyVista or Open3D are there.

Cloud = tuple[NDArray[np.float64], tuple[float, float, float]]


def show(result: RegistrationResult) -> bool:
    """Open the window and return once it is closed; False where there can be none."""
    if not has_display():
        return False
    placed = result.object_samples.transformed(result.T_object_scene.inverse())
    clouds = [
        (samples.points.double().cpu().numpy(), color)
        for samples, color in ((result.scene_samples, SCENE_COLOR), (placed, OBJECT_COLOR))
    ]
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
