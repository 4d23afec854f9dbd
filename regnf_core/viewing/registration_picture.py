"""preview.png: the object over the scene at the start and at the end, and the residuals of both surfaces; of a search
also where its first two candidates differ.

It is drawn of a result, or of its stored files. Torch-free: the front end draws it too.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from regnf_core.viewing.difference_panel import DIFFERENCE, FILL, Deciding, difference_panel
from regnf_core.viewing.splats import Floats, Surfels, nearest_surfels, paint_half, view_from

if TYPE_CHECKING:
    from torch import Tensor

    from regnf_core.document import RegistrationResult

SCENE_COLOR = (0.38, 0.58, 0.80)
OBJECT_COLOR = (0.95, 0.56, 0.20)
_BACKGROUND = np.array([0.975, 0.975, 0.97])
_INK = (52, 56, 62)
_PANEL = 480
_CAPTION = 52
_ELEVATION = np.radians(28.0)
_RAMP_TOP = 0.015  # object diameters: largest residual of an inlier, by the defaults of both presets
_DISC_SHARE = 1.5  # disc radius over the typical gap of the cloud: closes the gaps
_GAPS = 64
"""At least so many points tell what is typical, where there are as many."""
_RESIDUALS = ("scene_residuals", "object_residuals")
_PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1"}
FAST = 1
"""Of nine levels of PNG's compression: a file one eighth larger than at the usual one, in half the time."""
_RAMP = np.array(  # dark blue over teal to yellow: even in brightness, readable without telling red from green
    [[0.18, 0.20, 0.46], [0.19, 0.42, 0.56], [0.16, 0.62, 0.54], [0.53, 0.79, 0.34], [0.98, 0.88, 0.18]]
)


def registration_picture(result: RegistrationResult) -> Image.Image:
    """Three panels side by side: at the start, at the end, and the residuals of both surfaces; a fourth one where the
    result has a deciding surface. As the camera of the detection's image sees them, if there is one; else upright in
    the scene's frame."""
    found = result.deciding
    shown = _Shown(
        (_numbers(result.scene_samples.points), _numbers(result.scene_samples.normals)),
        (_numbers(result.object_samples.points), _numbers(result.object_samples.normals)),
        [_numbers(result.residuals[name]) for name in _RESIDUALS],
        [_numbers(T.matrix()) for T in (result.T_object_scene_initial, result.T_object_scene)],
        None if result.camera is None else _numbers(result.camera.T_world_camera.matrix()),
        result.options["up_axis"] or "z",
        result.verdict,
        result.metrics,
        None
        if found is None
        else Deciding(
            _numbers(found.samples.points),
            found.of_other.cpu().numpy(),
            found.states.cpu().numpy(),
            found.distinguishable,
        ),
    )
    return _drawn(shown)


def _numbers(values: Tensor) -> Floats:
    found: Floats = values.double().cpu().numpy()
    return found


def stored_picture(open_file: Callable[[str], BinaryIO]) -> bytes:
    """The picture of a registration whose files are stored, as PNG. open_file: a file by its name.

    Files that are none of ours raise ValueError, KeyError, TypeError or IndexError.
    """

    def read(name: str) -> bytes:
        with open_file(name) as file:
            return file.read()

    document = json.loads(read("result.json"))
    arrays = np.load(io.BytesIO(read("residuals.npz")), allow_pickle=False)
    deciding = None
    with suppress(FileNotFoundError):
        vertices = _vertices(read(DIFFERENCE))
        apart = document["candidates"][1]["difference"]["distinguishable"]
        deciding = Deciding(_columns(vertices, "x", "y", "z"), vertices["candidate"] == 2, vertices["state"], apart)
    camera = document.get("camera")
    shown = _Shown(
        _cloud(read("scene_points.ply")),
        _cloud(read("object_points.ply")),
        [arrays[name].astype(np.float64) for name in _RESIDUALS],
        [np.array(document[name]["matrix"]) for name in ("T_object_scene_initial", "T_object_scene")],
        None if camera is None else np.array(camera["T_scene_camera"]["matrix"]),
        document["options"]["up_axis"] or "z",
        document["verdict"],
        document["metrics"],
        deciding,
    )
    written = io.BytesIO()
    _drawn(shown).save(written, "PNG", compress_level=FAST)
    return written.getvalue()


def _cloud(data: bytes) -> tuple[Floats, Floats]:
    """Points and normals (N, 3) of a PLY file."""
    vertices = _vertices(data)
    return _columns(vertices, "x", "y", "z"), _columns(vertices, "nx", "ny", "nz")


def _vertices(data: bytes) -> NDArray[Any]:
    """The rows of a binary PLY file of nothing but vertices, by the names of their properties."""
    header, _, rows = data.partition(b"end_header\n")
    said = [line.split() for line in header.decode("ascii").splitlines()]
    columns = [(line[2], _PLY_TYPES[line[1]]) for line in said if line[0] == "property"]
    return np.frombuffer(rows, np.dtype(columns))


def _columns(vertices: NDArray[Any], *names: str) -> Floats:
    return np.stack([vertices[name] for name in names], axis=1).astype(np.float64)


@dataclass(frozen=True)
class _Shown:
    """What a picture shows. scene, object: points and unit normals (N, 3), each in its own frame · residuals: (N,), of
    their points · T_object_scene: 4x4, at the start and at the end · camera: 4x4, to the scene's frame."""

    scene: tuple[Floats, Floats]
    object: tuple[Floats, Floats]
    residuals: Sequence[Floats]
    T_object_scene: Sequence[Floats]
    camera: Floats | None
    up_axis: str
    verdict: str
    metrics: Mapping[str, float]
    deciding: Deciding | None


def _drawn(shown: _Shown) -> Image.Image:
    scene = _surfels(*shown.scene, SCENE_COLOR)
    start, end = (_placed(*shown.object, np.linalg.inv(T_object_scene)) for T_object_scene in shown.T_object_scene)
    if shown.camera is None:
        up = np.eye(3)["xyz".index(shown.up_axis)]
        direction = _best_direction(scene, up)
    else:
        up, direction = -shown.camera[:3, 1], shown.camera[:3, 3] - scene.points.mean(0)
    edge = 2 * _PANEL
    view = view_from(direction, up, np.concatenate([scene.points, start.points, end.points]), edge)
    radius = _DISC_SHARE * max(_typical_gap(cloud.points) for cloud in (scene, end))
    before, after = Surfels.join(scene, start), Surfels.join(scene, end)
    top = _RAMP_TOP * shown.metrics["object_diameter"]
    residual = replace(after, colors=residual_colors(np.abs(np.concatenate(shown.residuals)) / top))
    in_front = nearest_surfels(after, view, edge, radius)
    panels = [
        paint_half(before, nearest_surfels(before, view, edge, radius), view, _BACKGROUND),
        paint_half(after, in_front, view, _BACKGROUND),
        paint_half(residual, in_front, view, _BACKGROUND),  # the same discs in other colors
    ]
    pictures = [Image.fromarray(panel) for panel in panels]
    if shown.deciding is not None:
        around = np.concatenate([after.points, shown.deciding.points])
        wider = view_from(direction, up, around, edge, FILL)
        pictures.append(difference_panel(after, radius, shown.deciding, wider, edge, _BACKGROUND))
    width = len(pictures) * _PANEL
    sheet = Image.new("RGB", (width, _PANEL + _CAPTION), tuple(int(255 * part) for part in _BACKGROUND))
    for number, picture in enumerate(pictures):
        sheet.paste(picture, (number * _PANEL, _CAPTION))
    _captions(sheet, shown)
    return sheet


def residual_colors(shares: Floats) -> Floats:
    """(N, 3) colors of |residuals| (N,) given as a share of the ramp's top, clipped to it."""
    position = np.clip(shares, 0.0, 1.0) * (len(_RAMP) - 1)
    low = np.minimum(position.astype(np.int64), len(_RAMP) - 2)
    weight = (position - low)[:, None]
    colors: Floats = (1.0 - weight) * _RAMP[low] + weight * _RAMP[low + 1]
    return colors


def _surfels(points: Floats, normals: Floats, color: tuple[float, float, float]) -> Surfels:
    return Surfels(points, normals, np.broadcast_to(np.array(color), points.shape))


def _placed(points: Floats, normals: Floats, T_scene_object: NDArray[Any]) -> Surfels:
    turned = T_scene_object[:3, :3]
    scale = np.cbrt(np.linalg.det(turned))
    return _surfels(points @ turned.T + T_scene_object[:3, 3], normals @ turned.T / scale, OBJECT_COLOR)


def _typical_gap(points: Floats) -> float:
    """The median distance of some of the points (N, 3) to their third neighbors."""
    some = points[:: max(1, len(points) // _GAPS)]
    third = min(3, len(points) - 1)  # the nearest is the point itself
    return float(np.sqrt(np.median([np.partition(((points - one) ** 2).sum(1), third)[third] for one in some])))


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


def _captions(sheet: Image.Image, shown: _Shown) -> None:
    draw = ImageDraw.Draw(sheet)
    title, small = ImageFont.load_default(size=20), ImageFont.load_default(size=14)
    scale = np.cbrt(np.linalg.det(shown.T_object_scene[-1][:3, :3]))
    texts = [
        ("Start", "object (orange) over the scene (blue)"),
        (shown.verdict.capitalize(), f"scale {scale:.4f}, after {int(shown.metrics['iterations'])} iterations"),
        ("Residual", "|S_object(T x) - s S_scene(x)|"),
    ]
    if shown.deciding is not None:
        texts.append(("Difference between the first two candidates", shown.deciding.conclusion()))
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
