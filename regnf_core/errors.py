"""Every error regnf raises on purpose, each with a stable ``reason`` that programs may switch on.

    RegnfError
    ├── InvalidInputError            the caller can mend it
    │   ├── InvalidOptionsError      INVALID_OPTIONS, PRESET_UNSUITABLE
    │   ├── InvalidDetectionError    INVALID_DETECTION, DETECTION_OUTSIDE_SCENE
    │   ├── FieldFormatError         the bytes are no field we take: the reason says which stage refused them
    │   └── DatasetError             DATASET_...: a folder of posed images, or what one is rendered from, cannot be used
    ├── NoSurfaceError               NO_SURFACE_IN_DETECTION, NO_SURFACE_IN_OBJECT
    ├── InitializationError          NO_INITIAL_TRANSFORM
    ├── FitDivergedError             FIT_DIVERGED
    ├── MissingExtraError            EXTRA_MISSING
    └── CancelledError               CANCELLED

This module imports nothing heavy: the HTTP front end uses it without loading torch.
"""

from __future__ import annotations

import difflib
import errno
import os
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# One of several functions that a file may stand for, where nothing in it tells which: what a person is asked.

MOST_CANDIDATES = 6
"""So many are shown at most, the likeliest first."""


@dataclass(frozen=True)
class Candidate:
    """name: what distinguishes it, a few words · description: the entries of a description that choose it, to be added
    to what was said · picture: a PNG, two views of its surface and a section, where one could be made."""

    name: str
    description: Mapping[str, Any]
    picture: bytes | None = None

    def added_to(self, said: Mapping[str, Any]) -> dict[str, Any]:
        """The whole description that chooses it, where ``said`` was said before."""
        return _merged(said, self.description)


@dataclass(frozen=True)
class Said:
    """What a user said of a field. use: what it was named as on a command line, scene or object, where that is known ·
    description: its entries, see UploadDescription."""

    use: str | None
    description: Mapping[str, Any]


def _merged(said: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    whole = dict(said)
    for name, value in more.items():
        held = whole.get(name)
        whole[name] = _merged(held, value) if isinstance(held, Mapping) and isinstance(value, Mapping) else value
    return whole


# What to do next, by the stable reason of an error or of a verdict; and the name that was meant.
#
# Command line, problem objects, result documents and page all show these. Torch-free.

HINTS: dict[str, str] = {
    "NO_SURFACE_IN_DETECTION": "Check that the box is in the scene field's own frame and units, and that it encloses "
    "the object.",
    "NO_SURFACE_IN_OBJECT": "The object's field has no zero level within its bounds. Check its bounds and its sign: "
    "positive outside, negative inside.",
    "DETECTION_OUTSIDE_SCENE": "Write the box in the scene field's own frame and units; `regnf inspect` shows the "
    "field's bounds.",
    "NO_INITIAL_TRANSFORM": "Too little of the object's shape is visible in the box, or it is another object. Try a "
    "tighter box, or another object of the library.",
    "LOW_OVERLAP": "The surfaces agree in part only. Use a box that encloses the whole object and nothing else.",
    "SEVERAL_POSES_AGREE": "Choose a pose among the alternatives. If things stand upright, set the option up_axis: "
    "poses that do not stand upright are left out.",
    "SCENE_UNEXPLAINED": "The box holds another object, or more than the object. Try a tighter box, or another object "
    "of the library.",
    "SURFACE_UNEXPLAINED": "Most often the object is a similar one, for example a chair without its cushion. If "
    "something lies on it, try a tighter box.",
    "FREE_SPACE_VIOLATED": (
        "Most often it is another object, or the scene's field lacks parts of this one. "
        "If neither is so, set up_axis (the object stands upright), or try another seed."
    ),
    "LOW_PROBABILITY": "Most often it is another object, or one of another shape of the same kind. Otherwise try more "
    "views of it.",
    "OUTSIDE_DETECTION": "Most often it is another object. Around a part of the object, increase the option "
    "robust.box_tolerance.",
    "TOO_LITTLE_SURFACE": "Too little of the object was observed. Fit the scene's field to more views, or use a box "
    "around more of the object.",
    "LARGE_RESIDUAL": "Most often it is another object. With the preset paper, try the preset robust or more "
    "iterations.",
    "FORMAT_NOT_RECOGNIZED": "Give the checkpoint that the trainer wrote, or a mesh as .glb, .ply, .obj or .stl;"
    " docs/import-gate.md lists what is taken.",
    "POINT_CLOUD_WITHOUT_NORMALS": "In Open3D: cloud.estimate_normals(), then"
    " orient_normals_consistent_tangent_plane(30); or give the mesh.",
    "POINT_CLOUD_NORMALS_DISAGREE": "Orient them all to free space, in Open3D: cloud.orient_normals_consistent_tangent"
    "_plane(30); or say accept_implausible in a description to take them as they are.",
    "POINT_CLOUD_TOO_SMALL": "Give more points of the surface, or the mesh.",
    "MESH_INVALID": "Open it in a viewer, and export it again as .glb, .ply, .obj or .stl.",
    "FORMAT_NOT_SUPPORTED": "docs/import-gate.md lists the files that are taken.",
    "FIELD_NOT_RECOGNIZED": "docs/import-gate.md lists the networks that are taken, and what a description may add.",
    "FILE_EMPTY": "Copy or download the file again.",
    "FILE_TRUNCATED": "Copy or download the file again, and compare its size with the original's.",
    "SAFE_FORMAT_INVALID": "The file is damaged, or no field of regnf. Copy it again, or give the checkpoint that it "
    "was made from.",
    "FIELD_IMPLAUSIBLE": "Look at it: regnf inspect FILE --picture field.png --description "
    "'{\"accept_implausible\": true}'",
    "LAYOUT_AMBIGUOUS": "Settings beside the checkpoint decide it. Without them, look at each: `regnf inspect FILE "
    "--candidates FOLDER` draws them; over HTTP, the field's error has their pictures.",
    "RUN_WITHOUT_CHECKPOINT": "Give the folder of one training run, or a file inside it; docs/import-gate.md lists "
    "the files that are taken.",
    "AMBIGUOUS_RUN": "Give one of the files by itself, with the settings beside it.",
    "ARCHIVE_LINK": "Pack the run again with what the link leads to: `tar --dereference`, or `zip -r` without `-y`.",
    "ARCHIVE_NESTED": "Unpack the outer archive, and give the inner one.",
    "SETTINGS_NOT_RECOGNIZED": "docs/import-gate.md lists the settings of each trainer.",
    "SETTINGS_UNSAFE": "Write the values themselves into the file, or say them in a description.",
    "SETTINGS_CONTRADICT_TENSORS": "Most often the settings are another run's. Give this checkpoint's own, or none.",
    "CAMERAS_NOT_RECOGNIZED": "docs/import-gate.md lists the files of cameras that are read.",
    "CAMERAS_INTRINSICS_MISSING": "With regnf convert: --intrinsics FX,FY,CX,CY,WIDTH,HEIGHT.",
    "CAMERAS_OF_ANOTHER_FRAME": "Give the trainer's settings, or dataset_transform in a description; or say which way "
    "cameras look: cameras.axes, opencv or opengl.",
    "TENSOR_SHAPE": "docs/families.md and docs/import-gate.md name the arrays of each family of fields.",
    "TENSOR_NOT_FINITE": "Write any number into nodes of a grid that were never seen, and 0 into its array `weights`; "
    "of a network, give an earlier checkpoint.",
    "TRUNCATION_UNKNOWN": "Give the distance that the value 1 stands for: --scene-description '{\"truncation\": ...}', "
    "or --object-description; with inspect and convert --description; over HTTP `truncation` of the description.",
    "DATASET_NO_METADATA": "docs/datasets.md shows the layout: meta_data.json with frames, each with rgb_path, "
    "camtoworld and intrinsics.",
    "DATASET_METADATA_INVALID": "docs/datasets.md lists the members of meta_data.json.",
    "DATASET_CAMERA_UNSUPPORTED": "Undistort the images, and give the intrinsics of the undistorted ones.",
    "DATASET_NO_FRAMES": "meta_data.json lists the images under frames.",
    "DATASET_POSE_NOT_RIGID": "camtoworld is a rotation and a translation, rows first: no scale, no mirrored axis.",
    "DATASET_INTRINSICS_INVALID": "Write [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of these images.",
    "DATASET_INSTANCE_INVALID": "docs/datasets.md shows an instance.",
    "DATASET_PATH_OUTSIDE": "Copy the file into the folder, and write its path from there.",
    "DATASET_IMAGE_MISSING": "Paths are relative to the folder of meta_data.json.",
    "DATASET_IMAGE_INVALID": "Depths are images of one channel with whole numbers, or .npy; export the file again.",
    "DATASET_SIZES_DIFFER": "Images, depths and masks of a dataset have one size. Resize them (depths and masks "
    "without mixing pixels), and scale the intrinsics with them.",
    "DATASET_DEPTH_UNIT_MISSING": "Add depth_unit_scale_factor to meta_data.json: world units a step, 0.001 for "
    "millimeters where poses are in meters.",
    "DATASET_DEPTH_MISSING": "Name depth images with sensor_depth_path; 0 stands for no measurement.",
    "DATASET_TOO_LARGE": "Take fewer images, or smaller ones.",
    "DATASET_BOUNDS_EMPTY": "scene_box.aabb is the lowest corner, then the highest.",
    "DATASET_NO_COLOR_VARIETY": "Without depths only colors can be fitted. Check that the images are not of one color.",
    "DATASET_NOTHING_IN_BOUNDS": "Poses, depths and scene_box in meta_data.json must have the same unit. Check them.",
    "DATASET_FRAMES_DISAGREE": "docs/datasets.md says what poses and depths are; --camera-axes takes poses of OpenGL.",
    "DATASET_OF_ANOTHER_FRAME": "Give the images that the field was made from, in the field's frame and unit.",
    "DATASET_FOLDER_NOT_EMPTY": "Give another folder, or empty it.",
    "DATASET_FOLDER_MISSING": "Make the folder above it first.",
    "DATASET_LAYOUT_INVALID": "docs/datasets.md shows the layout of a room.",
    "DATASET_MESH_MISSING": "Give the folder of the meshes with --meshes.",
    "DATASET_NO_FREE_PATH": "Take fewer things, or a larger floor.",
    "DATASET_NO_VIEW": "Take another instance: others hide this one from everywhere.",
    "DATASET_NO_INSTANCE": "The layout's instances have the names under id.",
    "DATASET_FRAMES_INVALID": "A single view is one frame.",
    "DATASET_SCALE_INVALID": "Units per meter are a positive number.",
    "RAW_PICKLE": "Save it again with torch.save.",
    "INVALID_DETECTION": "docs/api.md shows every form of a detection.",
    "INVALID_OPTIONS": "docs/api.md lists every option with its range.",
    "DIGEST_MISMATCH": "Take the SHA-256 of the very bytes that are sent (`sha256sum FILE`), or POST /fields, which "
    "computes it.",
    "INVALID_DIGEST": "`sha256sum FILE` prints it; or POST /fields, which computes it.",
    "MALFORMED_MULTIPART": "Let the client write the body and its boundary: `curl -F name=@file`. docs/api.md names "
    "the parts that each address takes.",
    "JOB_NOT_FOUND": "GET /jobs lists the jobs that there are.",
    "WORKER_LOST": "Most often memory ran out. Post the same request to start it again, or use a worker with more "
    "memory.",
    "JOB_TIMEOUT": "Use fewer samples, or set a longer time limit for the service (REGNF_JOB_TIMEOUT_S).",
    "OPTIONS_TOO_COSTLY": "Decrease the options that `errors` names. For the preset paper most often: fewer views, a "
    "smaller image_size or a larger pixel_stride.",
    "JOB_DISK_LIMIT": "Use fewer rays or samples, or set a higher limit for the service (REGNF_JOB_SCRATCH_BYTES).",
    "IMPORT_TIMEOUT": "Send it again when the service has less to do, or set a longer time limit for the service "
    "(REGNF_IMPORT_TIMEOUT_S).",
    "IMPORT_TOO_COSTLY": "Make the field smaller (fewer triangles, nodes or layers), or set a higher limit for the "
    "service (REGNF_IMPORT_WORK_S).",
    "IMPORT_OUT_OF_MEMORY": "Make the file smaller (a coarser mesh or grid), use a machine with more memory, or set a "
    "higher limit for the service (REGNF_IMPORT_MEMORY_BYTES).",
    "TENSOR_TOO_LARGE": "Make it smaller: a coarser grid, or fewer levels of the table.",
    "IMPORT_OUTPUT_TOO_LARGE": "Make the field smaller: a coarser mesh or grid.",
    "IMPORT_CRASHED": "Try it once more. If it fails again, the service's log has the end of the import's output.",
    "FIELD_IMPORT_TIMEOUT": "Wait until the field is ready, then post the same request again.",
    "STORAGE_FULL": "Free space on the disk, or delete fields and jobs, then send it again.",
    "OUT_OF_MEMORY": "Use fewer rays or samples, a smaller field or a worker with more memory; or set a higher limit "
    "for the service (REGNF_JOB_MEMORY_BYTES).",
    "MESH_TOO_LARGE": "Reduce the number of its triangles, for example in MeshLab or Blender.",
    "MESH_EXTERNAL_REFERENCE": "Put everything into one file: export it as .glb.",
    "NO_ZERO_LEVEL": "Check its bounds and its sign: positive outside, negative inside. `regnf inspect FILE --picture "
    "field.png` draws it.",
    "FAMILY_NOT_SUPPORTED": "docs/import-gate.md lists the networks that are taken.",
    "LATENT_MISSING": "Give the latent codes of the decoder: docs/families.md says where they are looked for.",
    "UNSAFE_GLOBAL_IN_WEIGHTS": "Save the state_dict alone with torch.save: docs/families.md shows it.",
    "FILE_NOT_FOUND": "Check the path.",
    "FILE_IS_FOLDER": "Give a file inside it.",
    "FILE_IS_NO_FOLDER": "Name another folder.",
    "FILE_UNUSABLE": "Check who may read and write there, or name another place.",
    "FIT_DIVERGED": "Use fewer or better images, or another seed; docs/fitting.md says what images are needed.",
    "MALFORMED_JSON": "Check the brackets, commas and quotation marks there.",
    "INVALID_TRANSFORM": "Write a 4x4 with rows of x -> s R x + t, the last one 0 0 0 1.",
    "INVALID_REQUEST": "docs/api.md shows every member of a request.",
    "NO_WORKER": "Start a worker: `regnf worker`, or `regnf serve`, which brings its own.",
    "BOUNDS_INVALID": "Give two corners in a description, the lower one first: docs/import-gate.md shows it.",
    "INVALID_DESCRIPTION": "docs/import-gate.md lists every entry of a description.",
    "INVALID_SYMMETRY": "docs/how-to/symmetry.md shows how a symmetry is said.",
    "PRESET_UNSUITABLE": "Use the preset robust; or name one object, and leave the initial transform out.",
    "NO_SURFACE_IN_SCENE": "Check the scene's bounds and its sign: positive outside, negative inside.",
    "NO_SURFACE_IN_TARGET": "Give a mesh with triangles that have an area, or a field with a surface; "
    "`regnf inspect FILE` shows what a file holds.",
    "NO_PICTURE": "Convert the field to a grid, which is faster, and draw that: `regnf convert FILE grid.npz`.",
    "OBJECT_MODEL_INVALID": "Delete it: it is made again when it is needed.",
    "FIELD_NOT_FINITE": "The training may have diverged: give an earlier checkpoint.",
    "FIELD_NOT_A_FUNCTION": "Give the checkpoint that the trainer wrote; docs/import-gate.md lists what is taken.",
    "FIELD_NOT_FOUND": "Upload the field first. Another caller's fields are not shown.",
    "FIELD_REJECTED": "The field's own error says why; upload a corrected one.",
    "DEMO_DATA_MISSING": "Install regnf anew: its example fields are missing.",
    "EMBEDDED_REDIS_MISSING": "Install it: pip install 'regnf[embedded]'; or name a Redis in REGNF_REDIS_URL.",
    "INTERNAL": "This is a fault of regnf: please report it with what the log says.",
}
"""Errors may carry a hint of their own, which says more."""
_FAMILIES: dict[str, str] = {
    "DATASET_": "docs/datasets.md describes the folder of images that is taken.",
    "IMPORT_": "Give a smaller field or mesh; with a service, docs/runbook.md names the limits of imports.",
    "SETTINGS_": "docs/import-gate.md lists the settings of each trainer.",
    "CAMERAS_": "docs/import-gate.md lists the files of cameras that are read.",
    "CAMERA_": "docs/editing.md describes cameras.",
    "EDIT": "docs/editing.md describes every edit.",
    "RENDER_": "docs/editing.md names the limits of renderings.",
    "CHECKPOINT_": "Begin the fit anew, without the checkpoint; docs/fitting.md says when one is used.",
    "LIBRARY_": "docs/how-to/library.md describes libraries.",
    "RECORDING_": "docs/how-to/recording.md describes recordings.",
    "QUOTA_": "Wait until some of yours have ended, or delete some; docs/errors.md lists the quotas.",
    "TOO_MANY_": "Send fewer at once, and try again later.",
    "REDIS_": "docs/deployment.md describes how Redis is named and protected.",
    "STORAGE_": "docs/deployment.md describes storage.",
    "STATE_DIR_": "Give another folder with --state-dir.",
    "TEXT_": "Save it as UTF-8.",
    **dict.fromkeys(
        ("ARCHIVE_", "LEGACY_", "NPY_", "ONNX_", "PICKLE_", "SAFETENSORS_", "SQLITE_", "TENSOR_", "HASH_GRID_", "RUN_",
         "SAFE_FORMAT_", "FIELD_SHAPES_", "FIELD_INDEX_", "FIELD_KIND_"),
        "Copy the file again, or save it anew with its trainer; docs/import-gate.md lists what is taken.",
    ),
}  # fmt: skip
"""Of reasons that begin so and have no hint by themselves."""


def hint_of(reason: str) -> str | None:
    """What to do next about an error of this reason; None where it says all by itself."""
    family = next((hint for beginning, hint in _FAMILIES.items() if reason.startswith(beginning)), None)
    return HINTS.get(reason, family)


def verdict_hint(reason: str, options: Mapping[str, Any]) -> str:
    """What to do next about a verdict, under these options of the registration; "" where nothing needs to be done."""
    if reason == "SEVERAL_POSES_AGREE" and options.get("up_axis") is not None:
        return (
            "Choose a pose among the alternatives: all of them stand upright. A box that shows what tells the sides "
            "apart, or more views of it, may decide."
        )
    return HINTS.get(reason, "")


RENAMED: dict[str, str] = {
    "centre": "center",
    "initialisation": "initialization",
    "optimisation": "optimization",
    "regulariser_weight": "regularizer_weight",
    "colour": "color",
    "judgement": "verdict",
    "family": "kind",
    "max_hidden_share": "max_occluded_share",
}
"""Names of earlier versions, and what they are called now."""
_LONGEST_COMPARED = 64
_MIN_SIMILARITY = 0.6


def suggestion(name: str, known: Iterable[str]) -> str | None:
    """ "Did you mean `center`?" for a name that is not known; None where nothing is near."""
    near = nearest_name(name, known)
    return f"Did you mean `{near}`?" if near else None


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """The known name that is meant by one that is not known: its new name, or the most similar one."""
    names = sorted(known)
    renamed = RENAMED.get(name)
    if renamed in names:
        return renamed
    by_lower = {one.lower(): one for one in reversed(names)}
    if len(name) > _LONGEST_COMPARED:
        return None
    near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=_MIN_SIMILARITY)
    return by_lower[near[0]] if near else None


class RegnfError(Exception):
    """Base of all errors raised by regnf.

    ``reason`` is a stable UPPER_SNAKE word; the message is for people and may change. ``hint`` says what to do next:
    the one given, else the usual one for the reason, else None.
    """

    reason: str = "INTERNAL"

    def __init__(self, message: str, *, reason: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        if reason is not None:
            self.reason = reason
        self._hint = hint

    @property
    def hint(self) -> str | None:
        return self._hint or hint_of(self.reason)


class InvalidInputError(RegnfError):
    """Something the caller gave cannot be used."""

    reason = "INVALID_INPUT"


class InvalidOptionsError(InvalidInputError):
    """An option is unknown, of the wrong type or out of its range."""

    reason = "INVALID_OPTIONS"


class InvalidDetectionError(InvalidInputError):
    """A detection box is malformed, or lies outside the scene's bounds.

    ``place`` leads to the faulty member from the detection on: ("center", 0).
    """

    reason = "INVALID_DETECTION"

    def __init__(
        self, message: str, *, reason: str | None = None, hint: str | None = None, place: tuple[str | int, ...] = ()
    ) -> None:
        super().__init__(message, reason=reason, hint=hint)
        self.place = place


class FieldFormatError(InvalidInputError):
    """The bytes do not hold a field that regnf can take. ``reason`` tells the stage and the fault.

    candidates: the functions that a file may stand for, where that is why (LAYOUT_AMBIGUOUS). said: what the user
    said of the field, where that is known.
    """

    reason = "FIELD_NOT_RECOGNIZED"
    said: Said | None = None

    def __init__(
        self,
        message: str,
        *,
        reason: str | None = None,
        hint: str | None = None,
        candidates: Sequence[Candidate] = (),
    ) -> None:
        super().__init__(message, reason=reason, hint=hint)
        self.candidates = tuple(candidates)

    def told(self, message: str, hint: str | None = None) -> FieldFormatError:
        """The same error in other words."""
        error = FieldFormatError(message, reason=self.reason, hint=hint or self.hint, candidates=self.candidates)
        error.said = self.said
        return error


class DatasetError(InvalidInputError):
    """A folder of posed images cannot be read or written, or a scene cannot be rendered. ``reason`` tells the fault."""

    reason = "DATASET_INVALID"


class NoSurfaceError(RegnfError):
    """Too few surface points were found where the object should be."""

    reason = "NO_SURFACE_IN_DETECTION"


class InitializationError(RegnfError):
    """No initial transform could be estimated from the surface points."""

    reason = "NO_INITIAL_TRANSFORM"


class FitDivergedError(RegnfError):
    """A field that is being fitted is no longer made of numbers; its last checkpoint is kept."""

    reason = "FIT_DIVERGED"


class CancelledError(RegnfError):
    """The caller asked for the work to stop."""

    reason = "CANCELLED"


class MissingExtraError(RegnfError):
    """An extra of the package that is needed is not installed, or only in part."""

    unavailable = True
    reason = "EXTRA_MISSING"

    @classmethod
    def of(cls, modules: Sequence[str], extras: Sequence[str]) -> MissingExtraError:
        """Names the modules that are not there, and the extras that bring them."""
        return cls(f"not installed: {', '.join(modules)}; pip install 'regnf[{','.join(extras)}]'")


# Files that appear complete or not at all, and the names that they may have.

RECORDING_SUFFIX = ".rrd"
"""Of recordings for the viewer of rerun."""


@contextmanager
def atomic_path(path: str | os.PathLike[str], durable: bool = False) -> Iterator[Path]:
    """A path beside ``path`` to write to. It is renamed to ``path`` at the end, or removed after an error.

    durable: the content is on the disk before the rename, so that a power failure leaves no incomplete file either.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.part")
    try:
        yield temporary
        if durable:
            _flush_to_disk(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def made_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """The folder, made with those above it if need be. After an error the made ones go again, if they are empty."""
    folder = Path(path)
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except BaseException:
        for one in missing:
            with suppress(OSError):
                one.rmdir()
        raise


@contextmanager
def filled_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A folder to write files into, which lie in the folder ``path`` at the end. After an error none of them does."""
    with made_folder(path) as target, tempfile.TemporaryDirectory(dir=target) as work:
        yield Path(work)
        for made in sorted(Path(work).iterdir()):
            made.replace(target / made.name)


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Raises PermissionError unless the folder may be written into, or made. Nothing is made."""
    place = next(one for one in (Path(folder).absolute(), *Path(folder).absolute().parents) if one.exists())
    if not os.access(place, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))


def new_file(path: str | os.PathLike[str], suffix: str) -> Path:
    """The path of a file to write, whose name ends in ``suffix``.

    Raises InvalidOptionsError for another name, InvalidInputError (FILE_IS_FOLDER) where there is a folder.
    """
    target = Path(path)
    if target.is_dir():
        hint = f"Name a file in it: {target / 'result'}{suffix}"
        raise InvalidInputError(f"{target}: a folder, expected a file to write", reason="FILE_IS_FOLDER", hint=hint)
    if target.suffix != suffix:
        raise InvalidOptionsError(f"{target}: expected a name that ends in {suffix}")
    return target


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# What each reason of a verdict means, in words, for result documents, command line and page. Torch-free.

VERDICT_REASONS: dict[str, str] = {
    "SURFACES_AGREE": "Object and scene match on held-out points.",
    "SEVERAL_POSES_AGREE": "Several poses match the data equally well: this one and the alternatives.",
    "LOW_OVERLAP": "Too small a share of the two surfaces matches.",
    "LARGE_RESIDUAL": "The surfaces are too far apart where they should coincide (preset paper).",
    "FREE_SPACE_VIOLATED": "The object would occupy space that the scene shows as empty.",
    "SURFACE_UNEXPLAINED": "Next to the object the scene has surface that does not belong to it: the object is a"
    " similar one, or something is attached to it.",
    "SCENE_UNEXPLAINED": "The object explains too little of the surface in the box.",
    "LOW_PROBABILITY": "The pose is unlikely: most often because the object fits about as well elsewhere in the box.",
    "OUTSIDE_DETECTION": "At the best pose the object reaches far beyond the detection box, or is far smaller than it.",
    "TOO_LITTLE_SURFACE": "Too much of the object would be occluded or unobserved: the rest is too little to check the"
    " pose.",
}
"""By the stable UPPER_SNAKE word that results carry as ``verdict_reason``."""


def verdict_in_words(reason: str, limit: str = "") -> str:
    """The reason's sentence and, where a limit was not kept, both of its numbers."""
    said = VERDICT_REASONS.get(reason, "")
    return f"{said} {limit[:1].upper()}{limit[1:]}.".strip() if limit else said
