"""One whole rendering: a scene and a request in, files out. What the command line and a service run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image

from regnf_core.editing.compose import compose
from regnf_core.editing.edited_scene import EditedScene, without_unseen
from regnf_core.editing.edits import open_edits
from regnf_core.editing.storing import write_field
from regnf_core.errors import atomic_path
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.rendering.camera import Camera, Frame, orbit_cameras
from regnf_core.rendering.render import Progress, render_frames
from regnf_core.rendering.request import OrbitRequest, PoseRequest, RenderOptions, RenderRequest
from regnf_core.rendering.volume_mode import Painter
from regnf_core.surface.exporting import glb_of
from regnf_core.surface.isosurface import extract_surface

# The surface of a field as a mesh with a color at each vertex.

_AT_ONCE = 1 << 16


def write_colored_mesh(
    field: SdfField, path: Path, resolution: int, options: RenderOptions, progress: Callable[[int], None]
) -> None:
    """The zero level as .glb, in the field's frame and unit.

    A vertex has its part's own color, seen from before the surface, or its tint, or one plain color: no shading.
    Raises NoSurfaceError and InvalidInputError (FIELD_NOT_FINITE, COLORS_MISSING).
    """
    field, origin = near_origin(field)
    surface = extract_surface(field, resolution, progress)
    painter = Painter.of(field, options)
    points, normals = (torch.from_numpy(part).float() for part in (surface.vertices, surface.normals))
    parts = zip(torch.split(points, _AT_ONCE), torch.split(normals, _AT_ONCE), strict=True)
    colors = torch.cat([painter.colors(p.to(field.device), -n.to(field.device))[0].cpu() for p, n in parts])
    levels = (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    shown = np.concatenate([levels, np.full((len(levels), 1), 255, np.uint8)], axis=1)
    mesh = trimesh.Trimesh(
        surface.vertices, surface.faces, vertex_normals=surface.normals, vertex_colors=shown, process=False
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(glb_of(mesh, origin.numpy()))


# Frames as files.

_GAP = 6
"""Pixels between the pictures of a strip."""
_FRAME_MS = round(1000 / 12)
Picture = NDArray[np.uint8]
"""(H, W, 3)"""


def depth_unit(largest: float) -> float:
    """Scene units a level of a depth PNG, so that ``largest`` fits 16 bits: a power of ten, times 1, 2 or 5."""
    if largest <= 0:
        return 1.0
    least = largest / 65000.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least))


def _save(picture: NDArray[Any], path: Path) -> None:
    Image.fromarray(picture).save(path, format="PNG")


def _side_by_side(pictures: Sequence[Picture]) -> Picture:
    gap = np.full((pictures[0].shape[0], _GAP, 3), 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1)


_STAGES = {"composing": 0.0, "rendering": 0.1, "rendering before": 0.5, "mesh": 0.9, "field": 0.95, "done": 1.0}
"""The share done when each begins."""
_PHASES = {"composing": 0.0, "rendering": 0.1, "exporting": 0.9}
"""What is told of a job: fewer than the stages."""
_PNG, _BYTES = "image/png", "application/octet-stream"


@dataclass(frozen=True)
class RenderArtifact:
    """One file. name: in the folder, of letters, digits, '.' and '-' · kind: an output of the request · frame: its
    number, None for what is of all frames · before: whether it shows the scene without its edits."""

    name: str
    kind: str
    media_type: str
    frame: int | None = None
    before: bool = False


@dataclass(frozen=True)
class RenderReport:
    """What was written (render.json beside it says the same), the seconds of each stage, and what a level of the depth
    PNGs is in scene units."""

    artifacts: list[RenderArtifact] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    depth_unit: float = 1.0


def phase_of(share: float) -> str:
    """What goes on when this share is done: composing, rendering or exporting."""
    return [name for name, begin in _PHASES.items() if share >= begin][-1]


def run_render(
    scene: SdfField,
    request: RenderRequest,
    open_object: Callable[[str], SdfField],
    directory: Path,
    progress: Progress | None = None,
    processes: int = 1,
) -> RenderReport:
    """Write the request's files into the existing folder ``directory``.

    open_object: the field of an object that an edit names · processes: see ``render_frames``. Files: frame-0000.png
    (color), frame-0000-depth.png (16 bit) and .npy, frame-0000-normal.png, and so on; before-0000.png and so on without
    edits; animation.webp, before-after.png, composite.glb, edited.safetensors, render.json.
    Raises what ``compose``, ``render_frames`` and ``progress`` raise; what was written by then is the caller's to drop.
    """
    request.check()
    work = _Work(request.outputs, directory, progress)
    with work.stage("composing"):
        scene = without_unseen(scene) if request.clear_unseen else scene
        edited = compose(scene, open_edits(request.edits, open_object), request.seed, work.tell)
    cameras = _cameras(request, edited)
    corners = torch.cartesian_prod(*edited.bounds.T)  # no depth is larger than to one of them
    unit = depth_unit(max(float((corners - camera.position).norm(dim=-1).max()) for camera in cameras))
    cut_away = replace(request.options, cut_away=True)

    def rendered(field: SdfField, options: RenderOptions) -> Iterator[Frame]:
        return render_frames(field, cameras, options, work.tell, processes=processes)

    with work.stage("rendering"):
        # nobody has chosen the places of an orbit: walls that they stand in are cut away
        chosen = request.look_at is not None or request.poses is not None
        after = work.frames(rendered(edited, request.options if chosen else cut_away), "frame", unit)
    before: list[Picture] = []
    if request.before and request.edits:
        with work.stage("rendering before"):
            # what the edits put before a camera may have stood around it
            before = work.frames(rendered(scene, cut_away), "before", unit)
    work.pictures(after, before)
    if "mesh" in request.outputs:
        with work.stage("mesh"):
            path = work.add("composite.glb", "mesh", "model/gltf-binary")
            write_colored_mesh(edited, path, request.mesh_resolution, request.options, lambda _: work.tell(0.0))
    if "field" in request.outputs:
        with work.stage("field"):
            write_field(edited, work.add("edited.safetensors", "field", _BYTES), request.field_resolution)
    return work.finish(unit)


class _Work:
    """The files as they come, and how far the work has come."""

    def __init__(self, outputs: Sequence[str], directory: Path, progress: Progress | None) -> None:
        self._outputs, self._directory, self._progress = outputs, directory, progress
        self._done, self._share = 0.0, (0.0, 1.0)
        self._artifacts: list[RenderArtifact] = []
        self._seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begins = list(_STAGES.values())
        self._share = _STAGES[name], begins[list(_STAGES).index(name) + 1]
        self.tell(0.0)
        start = time.perf_counter()
        yield
        self._seconds[name] = time.perf_counter() - start
        self.tell(1.0)

    def tell(self, share: float) -> None:
        """Report the share done of the present stage."""
        first, last = self._share
        self._done = max(self._done, first + share * (last - first))
        if self._progress is not None:
            self._progress(self._done)

    def add(self, name: str, kind: str, media_type: str = _PNG, frame: int | None = None, before: bool = False) -> Path:
        self._artifacts.append(RenderArtifact(name, kind, media_type, frame, before))
        return self._directory / name

    def frames(self, rendered: Iterator[Frame], stem: str, unit: float) -> list[Picture]:
        """Write them; their colors, where a strip or an animation needs them."""
        colors: list[Picture] = []
        for number, frame in enumerate(rendered):
            self._write(frame, number, stem, unit)
            if "animation" in self._outputs or ("strip" in self._outputs and number == 0):
                colors.append(frame.color)
        return colors

    def _write(self, frame: Frame, number: int, stem: str, unit: float) -> None:
        """Color as 8 bits a channel, sRGB; depths as .npy and as 16 bits in ``unit``; normals as 0..255 for -1..1 along
        the scene's axes. 0 where nothing is met."""
        name, which = f"{stem}-{number:04d}", (number, stem == "before")
        if "color" in self._outputs:
            _save(frame.color, self.add(f"{name}.png", "color", _PNG, *which))
        if "depth" in self._outputs:
            levels = np.clip(np.rint(frame.depth / unit), 0, 65535).astype(np.uint16)
            _save(levels, self.add(f"{name}-depth.png", "depth", _PNG, *which))
            np.save(self.add(f"{name}-depth.npy", "depth", _BYTES, *which), frame.depth)
        if "normal" in self._outputs:
            normals = np.rint((frame.normal + 1.0) * 127.5).astype(np.uint8)
            normals[frame.depth <= 0] = 0
            _save(normals, self.add(f"{name}-normal.png", "normal", _PNG, *which))

    def pictures(self, after: list[Picture], before: list[Picture]) -> None:
        if "strip" in self._outputs and before:
            _save(_side_by_side([before[0], after[0]]), self.add("before-after.png", "strip"))
        if "animation" in self._outputs:
            both = [_side_by_side(pair) for pair in zip(before, after, strict=True)] if before else after
            first, *others = [Image.fromarray(picture) for picture in both]
            path, timing = self.add("animation.webp", "animation", "image/webp"), {"duration": _FRAME_MS, "loop": 0}
            first.save(path, format="WEBP", save_all=True, append_images=others, quality=80, **timing)

    def finish(self, unit: float) -> RenderReport:
        self.add("render.json", "report", "application/json")
        report = RenderReport(self._artifacts, self._seconds, unit)
        (self._directory / "render.json").write_text(json.dumps(asdict(report), indent=1) + "\n", encoding="utf-8")
        self._share = (1.0, 1.0)
        self.tell(1.0)
        return report


def _cameras(request: RenderRequest, edited: EditedScene) -> list[Camera]:
    size = request.image_size
    if request.look_at is not None:
        return [
            Camera.look_at(one.position, one.target, size, one.field_of_view_deg, one.up) for one in request.look_at
        ]
    if request.poses is not None:
        return [_posed(one).resized(size) for one in request.poses]
    orbit = request.orbit or OrbitRequest()
    if orbit.detection is not None:
        looked_at = OrientedBox.from_detection(orbit.detection)
    elif edited.places:
        looked_at = edited.places[orbit.edit or 0]
    else:
        looked_at = OrientedBox.from_corners(*edited.bounds.tolist())
    return orbit_cameras(orbit, looked_at, size)


def _posed(pose: PoseRequest) -> Camera:
    matrix = torch.tensor(pose.T_scene_camera, dtype=torch.float64)
    fx, fy, cx, cy = pose.intrinsics
    return Camera(matrix[:3, 3], matrix[:3, :3], *pose.size, (fx, fy), (cx, cy))
