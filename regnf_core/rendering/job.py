"""One whole rendering: a scene and a request in, files out. What the command line and a service run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image

from regnf_core.editing.compose import compose
from regnf_core.editing.edited_scene import EditedScene
from regnf_core.editing.edits import open_edits
from regnf_core.editing.region import without_unseen
from regnf_core.editing.storing import write_field
from regnf_core.errors import CancelledError, atomic_path
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.rendering.camera import Camera, Frame, Orbit, Station
from regnf_core.rendering.render import Progress, render_frames
from regnf_core.rendering.request import OrbitRequest, RenderOptions, RenderRequest
from regnf_core.rendering.volume_mode import Painter
from regnf_core.surface.exporting import glb_of
from regnf_core.surface.isosurface import extract_surface

# The surface of a field as a mesh with a color at each vertex.

_AT_ONCE = 1 << 16


def write_colored_mesh(
    field: SdfField,
    path: Path,
    resolution: int,
    options: RenderOptions,
    progress: Callable[[int], None] | None = None,
) -> int:
    """The zero level as .glb, in the field's frame and unit; returns how many triangles it has.

    A vertex has its part's own color, seen from before the surface, or its tint, or one plain color: no shading.
    Raises NoSurfaceError and InvalidInputError (FIELD_NOT_FINITE, COLORS_MISSING).
    """
    field, origin = near_origin(field)
    surface = extract_surface(field, resolution, progress)
    painter = Painter.of(field, torch.tensor([0.0, 0.0, 1.0]), options)
    points, normals = (torch.from_numpy(part).float() for part in (surface.vertices, surface.normals))
    parts = zip(torch.split(points, _AT_ONCE), torch.split(normals, _AT_ONCE), strict=True)
    colors = torch.cat([painter.flat_colors(p.to(field.device), -n.to(field.device)).cpu() for p, n in parts])
    levels = (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    shown = np.concatenate([levels, np.full((len(levels), 1), 255, np.uint8)], axis=1)
    mesh = trimesh.Trimesh(
        surface.vertices, surface.faces, vertex_normals=surface.normals, vertex_colors=shown, process=False
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(glb_of(mesh, origin.numpy()))
    return len(surface.faces)


# Frames as files.

_GAP = 6
"""Pixels between the pictures of a strip."""
_WHITE = 255
_FRAMES_A_SECOND = 12


def write_color(frame: Frame, path: Path) -> None:
    """PNG, 8 bits a channel, sRGB."""
    Image.fromarray(frame.color).save(path, format="PNG")


def write_normal(frame: Frame, path: Path) -> None:
    """PNG, 8 bits a channel: 0..255 for -1..1 along the scene's axes; (0, 0, 0) where nothing is met."""
    levels = np.rint((frame.normal + 1.0) * 127.5).astype(np.uint8)
    levels[frame.depth <= 0] = 0
    Image.fromarray(levels).save(path, format="PNG")


def write_depth(frame: Frame, png: Path, npy: Path, unit: float) -> None:
    """The depths as .npy (float32, scene units), and as PNG of 16 bits in ``unit``; 0 where nothing is met."""
    np.save(npy, frame.depth)
    levels = np.clip(np.rint(frame.depth / unit), 0, 65535).astype(np.uint16)
    Image.fromarray(levels).save(png, format="PNG")


def depth_unit(largest: float) -> float:
    """Scene units a level of a depth PNG, so that ``largest`` fits 16 bits: a power of ten, times 1, 2 or 5."""
    if largest <= 0:
        return 1.0
    least = largest / 65000.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least))


def write_animation(pictures: Sequence[NDArray[np.uint8]], path: Path) -> None:
    """Animated WebP of pictures (H, W, 3), in a loop."""
    first, *others = [Image.fromarray(picture) for picture in pictures]
    duration = round(1000 / _FRAMES_A_SECOND)
    first.save(path, format="WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=80)


def strip(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures (H, W, 3) of one height side by side."""
    gap = np.full((pictures[0].shape[0], _GAP, 3), _WHITE, np.uint8)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=1)


_STAGES = {"composing": 0.0, "rendering": 0.1, "rendering before": 0.5, "mesh": 0.9, "field": 0.95, "done": 1.0}
"""The share done when each begins."""
_PHASES = {"composing": 0.0, "rendering": 0.1, "exporting": 0.9}
"""What is told of a job: fewer than the stages."""
_PNG, _NPY = "image/png", "application/octet-stream"


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
    cancelled: Callable[[], bool] | None = None,
    processes: int = 1,
) -> RenderReport:
    """Write the request's files into the existing folder ``directory``.

    open_object: the field of an object that an edit names · processes: see ``render_frames``. Files: frame-0000.png
    (color), frame-0000-depth.png (16 bit) and .npy, frame-0000-normal.png, and so on; before-0000.png and so on without
    edits; animation.webp, before-after.png, composite.glb, edited.safetensors, render.json.
    Raises what ``compose`` and ``render_frames`` raise, and CancelledError; what was written by then is the caller's to
    delete.
    """
    request.check()
    work = _Work(request, directory, progress, cancelled, processes)
    with work.stage("composing"):
        scene = without_unseen(scene) if request.clear_unseen else scene
        edited = compose(scene, open_edits(request.edits, open_object), request.seed, work.tell)
    cameras = _cameras(request, edited)
    unit = depth_unit(_farthest(edited, cameras))
    with work.stage("rendering"):
        after = work.frames(edited, cameras, "frame", unit, _options(request))
    before: list[NDArray[np.uint8]] = []
    if request.before and request.edits:
        with work.stage("rendering before"):
            # what the edits put before a camera may have stood round it
            shown = replace(request.options, cut_away=True)
            before = work.frames(scene, cameras, "before", unit, shown)
    work.pictures(after, before)
    if "mesh" in request.outputs:
        with work.stage("mesh"):
            path, count = directory / "composite.glb", request.mesh_resolution
            write_colored_mesh(edited, path, count, request.options, lambda points: work.tell(0.0))
            work.add("composite.glb", "mesh", "model/gltf-binary")
    if "field" in request.outputs:
        with work.stage("field"):
            write_field(edited, directory / "edited.safetensors", request.field_resolution)
            work.add("edited.safetensors", "field", "application/octet-stream")
    return work.finish(unit)


def _options(request: RenderRequest) -> RenderOptions:
    """The request's. Nobody has chosen the places of an orbit: walls that they stand in are cut away."""
    chosen = request.look_at is not None or request.poses is not None
    return request.options if chosen else replace(request.options, cut_away=True)


class _Work:
    """The files as they come, and how far the work has come."""

    def __init__(
        self,
        request: RenderRequest,
        directory: Path,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
        processes: int,
    ) -> None:
        self._request, self._directory, self._processes = request, directory, processes
        self._progress, self._cancelled = progress, cancelled
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
        """Report the share done of the present stage. Raises CancelledError when the work is to stop."""
        if self._cancelled is not None and self._cancelled():
            raise CancelledError("the rendering was cancelled")
        first, last = self._share
        self._done = max(self._done, first + share * (last - first))
        if self._progress is not None:
            self._progress(self._done)

    def add(self, name: str, kind: str, media_type: str, frame: int | None = None, before: bool = False) -> Path:
        self._artifacts.append(RenderArtifact(name, kind, media_type, frame, before))
        return self._directory / name

    def frames(
        self,
        scene: SdfField,
        cameras: Sequence[Camera],
        stem: str,
        unit: float,
        options: RenderOptions | None = None,
    ) -> list[NDArray[np.uint8]]:
        """Render and write them; their colors, where a strip or an animation needs them."""
        wanted = {"strip": 1, "animation": len(cameras)}
        keep = max((wanted.get(output, 0) for output in self._request.outputs), default=0)
        kept = []
        chosen = options or self._request.options
        rendered = render_frames(scene, cameras, chosen, self.tell, self._cancelled, self._processes)
        for number, frame in enumerate(rendered):
            self._write(frame, number, stem, unit)
            if number < keep:
                kept.append(frame.color)
        return kept

    def _write(self, frame: Frame, number: int, stem: str, unit: float) -> None:
        name, outputs, before = f"{stem}-{number:04d}", self._request.outputs, stem == "before"
        if "color" in outputs:
            write_color(frame, self.add(f"{name}.png", "color", _PNG, number, before))
        if "depth" in outputs:
            png = self.add(f"{name}-depth.png", "depth", _PNG, number, before)
            write_depth(frame, png, self.add(f"{name}-depth.npy", "depth", _NPY, number, before), unit)
        if "normal" in outputs:
            write_normal(frame, self.add(f"{name}-normal.png", "normal", _PNG, number, before))

    def pictures(self, after: list[NDArray[np.uint8]], before: list[NDArray[np.uint8]]) -> None:
        from PIL import Image

        outputs = self._request.outputs
        if "strip" in outputs and before:
            path = self.add("before-after.png", "strip", _PNG)
            Image.fromarray(strip([before[0], after[0]])).save(path, format="PNG")
        if "animation" in outputs:
            both = [strip(list(pair)) for pair in zip(before, after, strict=True)] if before else after
            write_animation(both, self.add("animation.webp", "animation", "image/webp"))

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
            Station(one.position, one.target, one.field_of_view_deg, one.up).camera(size) for one in request.look_at
        ]
    if request.poses is not None:
        return [_posed(one.T_scene_camera, one.intrinsics, one.size).resized(size) for one in request.poses]
    orbit = request.orbit or OrbitRequest()
    path = Orbit(
        orbit.frames,
        orbit.elevation_deg,
        orbit.start_deg,
        orbit.sweep_deg,
        orbit.distance,
        orbit.field_of_view_deg,
        orbit.up,
    )
    return path.cameras(_looked_at(orbit, edited), size)


def _looked_at(orbit: OrbitRequest, edited: EditedScene) -> OrientedBox:
    if orbit.detection is not None:
        return OrientedBox.from_detection(orbit.detection)
    if edited.places:
        return edited.places[orbit.edit or 0]
    low, high = edited.bounds.tolist()
    return OrientedBox.from_corners(low, high)


def _posed(rows: list[list[float]], intrinsics: list[float], size: tuple[int, int]) -> Camera:
    matrix = torch.tensor(rows, dtype=torch.float64)
    fx, fy, cx, cy = intrinsics
    return Camera(matrix[:3, 3], matrix[:3, :3], size[0], size[1], (fx, fy), (cx, cy))


def _farthest(field: SdfField, cameras: Sequence[Camera]) -> float:
    """No depth of these cameras is larger."""
    low, high = field.bounds
    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1))
    return max(float((corners - camera.position).norm(dim=-1).max()) for camera in cameras)
