"""Which layout a folder or file is, and its recording."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from regnf_core.errors import DatasetError, RegnfError
from regnf_data.posed_images import NO_TERMS, Terms
from regnf_data.recordings import documents, folders, phones
from regnf_data.recordings.recording import DepthFile, Given, Recording
from regnf_data.recordings.stored import is_stored, read_stored

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_MOST_LISTED = 12
_NEAR = 3
"""Folders below the one that was given in which recordings are looked for, to name them."""


@dataclass(frozen=True)
class Layout:
    """name: for `--layout` · words: for people · fits: whether a folder or file has it · read: its recording ·
    looks_for: the files that tell it · terms: where its files state what."""

    name: str
    words: str
    looks_for: str
    fits: Callable[[Path], bool]
    read: Callable[[Path, Given], Recording]
    terms: Terms = NO_TERMS

    def recording(self, path: Path, given: Given) -> Recording:
        """That at ``path``, with cameras whose axes are those that were given."""
        try:
            found = self.read(path, given)
        except (OSError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            if isinstance(error, RegnfError):
                raise
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EMFILE, errno.ENFILE):
                raise
            if isinstance(error, FileNotFoundError | NotADirectoryError):
                said = f"{path.name} does not have the layout {self.words}: it has no {Path(str(error.filename)).name}"
                raise DatasetError(said, reason="DATASET_NO_METADATA") from error
            # Readers check what is often wrong; of the rest the reason is all that there is to say.
            said = f"{path.name} cannot be read as {self.words}: {type(error).__name__}: {error}"
            raise DatasetError(said[:400], reason="DATASET_METADATA_INVALID") from error
        depth = found.frames[0].depth  # the notes of one file are those of all
        if isinstance(depth, DepthFile):
            found = replace(found, notes=(*found.notes, *depth.notes()))
        terms = self.terms if found.terms == NO_TERMS else found.terms  # a stored one knows those that it had
        if given.axes in (None, terms.axes):
            return replace(found, terms=terms)
        turned = (replace(one, T_world_camera=one.T_world_camera @ _OPENGL) for one in found.frames)
        return replace(found, frames=tuple(turned), terms=replace(terms, axes=str(given.axes)))


def _bag(path: Path, given: Given) -> Recording:
    from regnf_data.recordings.bags import read_bag

    return read_bag(path, given)


def _is_bag(path: Path) -> bool:
    return path.suffix in (".mcap", ".db3", ".bag") if path.is_file() else (path / "metadata.yaml").is_file()


_BOP = Terms("cam_R_w2c and cam_t_w2c", "cam_K", "depth_scale", to_camera=True)
SDFSTUDIO = Terms("camtoworld in meta_data.json", "intrinsics in meta_data.json", "depth_unit_scale_factor")
_NERFSTUDIO = Terms("transform_matrix", "fl_x, fl_y, cx, cy", "depth_unit_scale_factor", axes="opengl")
_BAG = Terms("tf and odometry", "CameraInfo", "the images' encoding")
_REDWOOD = Terms("the trajectory or pose graph", "camera_intrinsic.json")
_COLMAP = Terms("images.txt or .bin", "cameras.txt or .bin", to_camera=True)
LAYOUTS = (
    Layout("stored", "regnf's own", "*.safetensors", is_stored, lambda path, _: read_stored(path)),
    Layout("bop", "BOP", "scene_camera.json", documents.is_bop, documents.read_bop, _BOP),
    Layout(
        "sdfstudio", "sdfstudio", "meta_data.json", documents.is_sdfstudio, documents.read_sdfstudio, SDFSTUDIO
    ),
    Layout(
        "nerfstudio", "nerfstudio", "transforms.json", documents.is_nerfstudio, documents.read_nerfstudio, _NERFSTUDIO
    ),
    Layout("rosbag2", "a ROS bag", "metadata.yaml, *.mcap, *.db3, *.bag", _is_bag, _bag, _BAG),
    Layout("tum", "TUM RGB-D", "depth.txt, groundtruth.txt", folders.is_tum, folders.read_tum,
           Terms("groundtruth.txt", "camera.json")),
    Layout("scannet", "ScanNet, extracted", "pose/, depth/", folders.is_scannet, folders.read_scannet,
           Terms("pose/*.txt", "intrinsic/")),
    Layout("replica", "Replica (NICE-SLAM)", "traj.txt, results/", folders.is_replica, folders.read_replica,
           Terms("traj.txt", "cam_params.json", "scale")),
    Layout("redwood", "Redwood, Open3D", "depth/, *.log or pose_graph.json", folders.is_redwood, folders.read_redwood,
           _REDWOOD),
    Layout("colmap", "COLMAP with depth", "cameras.txt or .bin, depth/", documents.is_colmap, documents.read_colmap,
           _COLMAP),
    Layout("7scenes", "7-Scenes, 3DMatch", "*.pose.txt, *.depth.png", folders.is_seven_scenes,
           folders.read_seven_scenes, Terms("*.pose.txt", "camera-intrinsics.txt")),
    Layout("phone", "Polycam, 3D Scanner App, Record3D", "keyframes/, frame_*.json, metadata.json and depth/",
           phones.is_phone, phones.read_phone, Terms("the app's poses", "the app's intrinsics", axes="opengl")),
    Layout("frame", "one frame", "one depth image, intrinsics", folders.is_frame, folders.read_frame),
)  # fmt: skip


def read_layout(path: str | os.PathLike[str], given: Given | None = None) -> Recording:
    """The recording in a folder or file. No image is decoded yet.

    Raises DatasetError: DATASET_NOT_RECOGNIZED with what was looked for, and those of the layout's reader.
    """
    source, given = Path(path), given or Given()
    if not source.exists():
        raise DatasetError(f"there is no {source}", reason="DATASET_NOT_RECOGNIZED")
    if given.layout is not None:
        named = {layout.name: layout for layout in LAYOUTS}
        name = given.layout.partition(":")[0]  # a bag's topic may follow
        if name not in named:
            raise DatasetError(
                f"unknown layout {given.layout[:40]!r}: {', '.join(named)}", reason="DATASET_NOT_RECOGNIZED"
            )
        return named[name].recording(source, given)
    for layout in LAYOUTS:
        if layout.fits(source):
            return layout.recording(source, given)
    below = _recordings_below(source) if source.is_dir() else []
    if below:
        names = ", ".join(str(each.relative_to(source)) for each in below[:_MOST_LISTED])
        more = f" and {len(below) - _MOST_LISTED} more" if len(below) > _MOST_LISTED else ""
        raise DatasetError(
            f"{source.name} is not a recording, but contains {len(below)}: give one of {names}{more}",
            reason="DATASET_NOT_RECOGNIZED",
        )
    known = "; ".join(f"{layout.words}: {layout.looks_for}" for layout in LAYOUTS)
    said = f"{source.name} is not a known recording{_almost(source)}. Supported are {known}"
    raise DatasetError(said, reason="DATASET_NOT_RECOGNIZED")


def _almost(source: Path) -> str:
    """What a folder has of a recording, in words."""
    files = [p for pattern in ("[!.]*", "*/[!.]*") for p in sorted(source.glob(pattern)) if p.is_file()]
    depths = [p for p in files if "depth" in str(p.relative_to(source)).lower()]
    read = [p for p in depths if p.suffix.lower() in folders.DEPTHS]
    if depths and not read:
        return f": depth images are read from {', '.join(folders.DEPTHS)}"
    if not read:
        return ""
    return f": no poses were found for its {len(read)} depth images. Without poses, give one of them, {read[0].name}"


def has_layout(path: str | os.PathLike[str]) -> bool:
    """Whether there is a folder or file, and it has the layout of a recording."""
    return Path(path).exists() and any(layout.fits(Path(path)) for layout in LAYOUTS)


def _recordings_below(folder: Path) -> list[Path]:
    found: list[Path] = []
    level = [folder]
    for _ in range(_NEAR):
        level = sorted(child for parent in level for child in _folders(parent))[:1000]
        for child in level:
            if any(layout.fits(child) for layout in LAYOUTS[:-1]):
                found.append(child)
        level = [child for child in level if child not in found]
    return found


def _folders(folder: Path) -> list[Path]:
    try:
        return [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    except OSError:
        return []
