"""The public functions of the engine: they accept paths of fields, and options as dictionaries."""

from __future__ import annotations

import base64
import io
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

import regnf_core.batch as engine_batch
import regnf_core.library as engine
from regnf_core.batch import BatchOutcome, ModeledObject
from regnf_core.detections.parsing import BoxLike, detection_of
from regnf_core.document import Candidate, ProgressCallback, RegistrationResult, result_document, sure_in_words
from regnf_core.editing.compose import compose as engine_compose
from regnf_core.editing.edited_scene import EditedScene
from regnf_core.editing.edits import Edit
from regnf_core.errors import (
    InvalidDetectionError,
    InvalidInputError,
    InvalidOptionsError,
    NoSurfaceError,
    filled_folder,
    verdict_in_words,
)
from regnf_core.field_files import library_files, require_file
from regnf_core.field_notes import FieldNotes
from regnf_core.field_source import Role, find_source
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.metrics import uncertainty
from regnf_core.geometry.sim3 import Sim3
from regnf_core.in_memory import FieldWarning, HasGeometry, HasPoints, HasVertices, field_of
from regnf_core.library import LibraryObject, model_object, search_library
from regnf_core.loading import import_smallest_first, load_field
from regnf_core.object_models import object_model
from regnf_core.options import OptionsLike, RobustOptions, options_of, seed_of
from regnf_core.pairs import pairs_of
from regnf_core.rendering.camera import Camera, Frame
from regnf_core.rendering.render import render as engine_render
from regnf_core.rendering.request import RenderOptions
from regnf_core.robust.model import ObjectModel
from regnf_core.texts import json_value
from regnf_core.viewing.artifacts import write_artifacts
from regnf_core.viewing.recording import write_recording
from regnf_core.viewing.registration_picture import registration_picture, show

if TYPE_CHECKING:
    from PIL.Image import Image


# A field as a user names it.

FieldLike = SdfField | str | os.PathLike[str] | HasVertices | HasPoints | HasGeometry
"""An open field; the path of a file, of the folder of a training run or of an archive of such a folder; or a mesh or a
point cloud in memory, see :func:`regnf_core.in_memory.field_of`."""


@dataclass(frozen=True)
class Opened:
    """A field, its name and the notes of its import. Both are None for a field that the caller has opened."""

    field: SdfField
    name: str | None = None
    notes: FieldNotes | None = None


def opened(field: FieldLike, role: Role | None = None) -> Opened:
    """The field itself, or the field at a path, opened for its use. Raises the errors of ``open_field``."""
    if isinstance(field, str | os.PathLike):
        loaded = load_field(find_source(Path(field), role=role))
        for warning in loaded.notes.warnings:
            warnings.warn(f"{field}: {warning}", FieldWarning, stacklevel=4)
        return Opened(loaded.field, str(field), loaded.notes)
    return Opened(field_of(field, role))


def opened_pair(scene: FieldLike, obj: FieldLike) -> tuple[Opened, Opened]:
    """Both fields. Files are checked before a large one is imported. Raises the errors of ``open_field``."""
    given: dict[Role, FieldLike] = {"scene": scene, "object": obj}
    paths: dict[Role, Path] = {role: Path(one) for role, one in given.items() if isinstance(one, str | os.PathLike)}
    sources = [find_source(path, role=role) for role, path in paths.items()]
    found = {role: opened(one, role) for role, one in given.items() if role not in paths}
    import_smallest_first(sources)
    found |= {role: opened(given[role], role) for role in paths}
    return found["scene"], found["object"]


def notes_of(scene: Opened, obj: Opened) -> dict[str, FieldNotes] | None:
    """Notes of the imports, by role; None if there are none."""
    found = {"scene": scene.notes, "object": obj.notes}
    return {name: notes for name, notes in found.items() if notes is not None} or None


# A registration's result as a user holds it: it prints, draws and saves itself.


class ArrayTensor(Tensor):
    """A tensor of which ``numpy.array`` makes a copy: torch's own does not know the argument, and numpy warns of it."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray[Any, Any]:
        return np.array(self.detach().cpu().numpy(), dtype=dtype, copy=copy)

    def __deepcopy__(self, memo: dict[int, Any]) -> ArrayTensor:
        copied: ArrayTensor = memo.setdefault(id(self), self.clone())
        return copied


def _for_numpy(value: Any) -> Any:
    """The same with such tensors."""
    if isinstance(value, Tensor):
        return value.as_subclass(ArrayTensor)
    if isinstance(value, list | tuple):
        return type(value)(map(_for_numpy, value))
    if isinstance(value, Mapping):
        return {name: _for_numpy(one) for name, one in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{one.name: _for_numpy(getattr(value, one.name)) for one in fields(value)})
    return value


@dataclass(frozen=True, repr=False, eq=False)
class Registered(RegistrationResult):
    """The result of one registration, with the data to display it.

    object_name: the object's path, if it was given as a path · notes: the notes of the imports of scene and object ·
    detection: the box, scene frame · overlay: of depth images, the object's outline on the image.
    """

    object_name: str | None = None
    notes: Mapping[str, FieldNotes] | None = None
    detection: OrientedBox | None = None
    overlay: Image | None = None

    @classmethod
    def of(
        cls,
        result: RegistrationResult,
        object_name: str | None = None,
        notes: Mapping[str, FieldNotes] | None = None,
        detection: OrientedBox | None = None,
    ) -> Registered:
        """The engine's result."""
        values = {one.name: _for_numpy(getattr(result, one.name)) for one in fields(RegistrationResult)}
        return cls(**values, object_name=object_name, notes=notes, detection=_for_numpy(detection))

    @property
    def scale(self) -> float:
        """Object units per scene unit."""
        return float(self.T_object_scene.scale)

    @property
    def uncertainty(self) -> dict[str, Any] | None:
        """The standard deviations of the position of the object's center (``center_scene``, along the scene's x, y, z,
        scene units), of the rotation (``rotation_deg``, about the object's x, y, z) and of the scale
        (``scale_percent``). None with the preset `paper`."""
        if self.covariance is None:
            return None
        return uncertainty(self.covariance, self.T_object_scene, self.center_object)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values, as in result.json."""
        return result_document(self, object_name=self.object_name, fields=self.notes)

    def to_bop_csv(self, scene_id: int, image_id: int, object_id: int, seconds: float = -1.0) -> str:
        """The result as a line of BOP's result format: scene_id, im_id, obj_id, score, R, t in millimeters, time.

        The object's frame is that of its file. Poses are in the camera frame, so the scene must be depth images.
        Raises InvalidInputError (NO_CAMERA).
        """
        pose = self.T_camera_object
        if pose is None:
            hint = "Register in a depth image (regnf.Frame, or the path of a recording)."
            raise InvalidInputError("the scene of this result is a field, not an image", reason="NO_CAMERA", hint=hint)
        R, t = pose.rotation.flatten().tolist(), (1000.0 * pose.translation).tolist()
        score = self.probability if self.probability is not None else float(self.verdict == "registered")
        numbers = " ".join(f"{value:.8f}" for value in R), " ".join(f"{value:.6f}" for value in t)
        return f"{scene_id},{image_id},{object_id},{score:.6f},{numbers[0]},{numbers[1]},{seconds:.6f}"

    def save(self, folder: str | Path) -> list[Path]:
        """Write result.json, the point clouds, the pose and a picture into a folder, like ``regnf register
        --output``."""
        self._require_clouds()
        target = Path(folder)
        if target.exists() and not target.is_dir():
            hint = "Give a folder. It is created if it does not exist."
            raise InvalidInputError(f"{target}: a file, expected a folder", reason="FILE_IS_NO_FOLDER", hint=hint)
        with filled_folder(target) as folder:
            names = write_artifacts(self, folder, object_name=self.object_name, fields=self.notes)
            if self.overlay is not None:
                self.overlay.save(folder / "overlay.png")
                names.append("overlay.png")
        return [target / name for name in names]

    def plot(self, path: str | Path | None = None, window: bool | None = None) -> Image:
        """The picture of the registration. It is also written to ``path``, if a path is given.

        window: whether to open a window of PyVista or Open3D, if one of them and a display are available; None: only if
        no ``path`` is given.
        """
        self._require_clouds()
        picture = registration_picture(self)
        if path is not None:
            picture.save(path)
        if window or (window is None and path is None):
            show(self)
        return picture

    def save_recording(self, path: str | Path) -> Path:
        """Write the course of the registration as a recording (.rrd) for the rerun viewer. Returns the path.

        Needs the extra ``rerun``. docs/how-to/recording.md describes its content.
        Raises MissingExtraError, InvalidOptionsError, and InvalidInputError (NO_CLOUDS, FILE_IS_FOLDER,
        RECORDING_DISABLED).
        """
        self._require_clouds()
        return write_recording(self, path, self.detection, self.object_name)

    def _require_clouds(self) -> None:
        if not self.residuals:
            hint = "Register with clouds=True (the default)."
            raise InvalidInputError("the result has no point clouds to show", reason="NO_CLOUDS", hint=hint)

    def __repr__(self) -> str:
        sure = sure_in_words(self.probability, self.level)
        return f"<{self.verdict}: {self.verdict_reason}, scale {self.scale:.4g}{sure}>"

    def _repr_png_(self) -> bytes | None:
        """For notebooks."""
        if not self.residuals:
            return None
        stream = io.BytesIO()
        registration_picture(self).save(stream, "PNG")
        return stream.getvalue()

    def _repr_html_(self) -> str:
        """For notebooks."""
        reason = verdict_in_words(self.verdict_reason, self.verdict_limit) or self.verdict_reason
        rows = "".join(
            "<tr>" + "".join(f"<td style='text-align:right'>{value:.4f}</td>" for value in row) + "</tr>"
            for row in self.T_scene_object.matrix().tolist()
        )
        png = self._repr_png_()
        data = "" if png is None else base64.b64encode(png).decode()
        picture = f"<img alt='registration' src='data:image/png;base64,{data}'>" if data else ""
        sure = sure_in_words(self.probability, self.level)
        words = f"<b>{escape(self.verdict)}</b>: {escape(reason)} Scale {self.scale:.4g}{sure}."
        caption = "<caption>T_scene_object, the object's pose in the scene</caption>"
        return f"<div><p>{words}</p><table>{caption}{rows}</table>{picture}</div>"


# ``register`` and ``register_batch`` as users call them.


def register(
    scene: FieldLike,
    obj: FieldLike,
    detection: BoxLike,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    initial_transform: Sim3 | ArrayLike | None = None,
    object_model: ObjectModel | None = None,
    clouds: bool = True,
) -> Registered:
    """Find the pose of a known object in a scanned scene: rotation, position, scale and a verdict.

    scene, obj: fields, their paths, or meshes of trimesh or Open3D · detection: a box of regnf or Open3D, two corners,
    a detection's JSON, or the path of its file ·
    options: RegistrationOptions, or a dictionary of the options that differ from their defaults · progress: called with
    the phase and the overall progress, 0..1 · initial_transform: initial guess, a T_object_scene as a Sim3 or a 4x4
    matrix; it is searched first · object_model: the object's model from an earlier ``model_object`` · clouds: False
    makes no point clouds, which saves time if nothing is drawn or saved. Deterministic for a seed, on one machine and
    with the same number of threads. Raises InvalidOptionsError, InvalidDetectionError, FieldFormatError,
    InvalidInputError (NO_FIELD, FILE_NOT_FOUND, FIELD_NOT_FINITE), NoSurfaceError, InitializationError.
    """
    chosen, box, seed = options_of(options), box_of(detection), seed_of(seed)
    if initial_transform is not None and not isinstance(initial_transform, Sim3):
        initial_transform = Sim3.from_matrix(torch.as_tensor(initial_transform))
    place, thing = opened_pair(scene, obj)
    start = initial_transform, object_model
    result = engine.register(place.field, thing.field, box, chosen, seed, progress, *start, clouds)
    return Registered.of(result, thing.name, notes_of(place, thing), box)


def register_batch(
    scene: FieldLike,
    detections: Sequence[BoxLike],
    objects: Sequence[FieldLike | ModeledObject],
    pairs: Sequence[tuple[int, int]] | None = None,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> list[BatchOutcome[Registered]]:
    """Register pairs of detection and object, given by their indices (None: all combinations), with the preset
    `robust`.

    Shared data is computed once. A pair that fails does not stop the others. Arguments as in ``register``.
    Raises InvalidOptionsError for options of another preset, InvalidInputError (PAIR_UNKNOWN, NO_FIELD).
    """
    if isinstance(detections, OrientedBox | str | os.PathLike) or not isinstance(detections, Sequence):
        raise InvalidDetectionError("detections is a single box, expected a list", hint="Write a list: [box].")
    chosen, boxes, seed = options_of(options), [box_of(one) for one in detections], seed_of(seed)
    pairs_of(pairs, len(boxes), len(objects))  # before any field is opened
    place = opened(scene, "scene")
    fields = [one if isinstance(one, ModeledObject) else opened(one, "object") for one in objects]
    plain = [one.field if isinstance(one, Opened) else one for one in fields]
    outcomes = []
    for one in engine_batch.register_batch(place.field, boxes, plain, pairs, chosen, seed, progress, clouds):
        obj, result = fields[one.object], None
        known = obj if isinstance(obj, Opened) else Opened(obj.field)
        if one.result is not None:
            result = Registered.of(one.result, known.name, notes_of(place, known), boxes[one.detection])
        outcomes.append(BatchOutcome(one.detection, one.object, result, one.error))
    return outcomes


def box_of(detection: BoxLike) -> OrientedBox:
    """The box of a detection in any form. Raises InvalidDetectionError, and InvalidInputError (FILE_NOT_FOUND,
    MALFORMED_JSON)."""
    if isinstance(detection, str | os.PathLike):
        require_file(Path(detection))
        return OrientedBox.from_dict(json_value(Path(detection).read_bytes(), f"detection {detection}: "))
    return detection if isinstance(detection, OrientedBox) else OrientedBox.from_detection(detection_of(detection))


# ``search`` as users call it: which of several objects a detection shows.

Objects = str | Path | Sequence[FieldLike | LibraryObject] | Mapping[str, FieldLike]
"""A folder of fields, a list of fields or their paths, or fields by names of your own."""


@dataclass(frozen=True)
class Search:
    """ranking: all objects, the most probable first · unusable: objects without a surface, with the reason · result:
    the registration of the first."""

    ranking: list[Candidate]
    result: Registered
    unusable: dict[str, str]

    def __repr__(self) -> str:
        return f"<{self.ranking[0].name} of {len(self.ranking)} objects, {self.result!r}>"


def search(
    scene: FieldLike,
    objects: Objects,
    detection: BoxLike,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> Search:
    """Find which object is in the box, and its pose, with the preset `robust`.

    The model of an object that is given by its path is computed once and stored in the user's cache. Other arguments as
    in ``register``. Raises InvalidInputError (LIBRARY_EMPTY), InvalidOptionsError (PRESET_UNSUITABLE), NoSurfaceError,
    and what ``register`` raises.
    """
    chosen, box, seed = options_of(options), box_of(detection), seed_of(seed)
    chosen.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    library, unusable = modeled_library(objects, chosen.robust, [scene])
    place = opened(scene, "scene")
    found = search_library(place.field, box, library, chosen, seed, progress, clouds)
    first = found.ranking[0].name
    notes = None if place.notes is None else {"scene": place.notes}
    return Search(found.ranking, Registered.of(found.result, first, notes, box), unusable)


def modeled_library(
    objects: Objects, options: RobustOptions, scenes: Sequence[FieldLike]
) -> tuple[list[LibraryObject], dict[str, str]]:
    """The objects with their models, and of objects without a surface the reasons, by name. Files are imported, also
    those of the scenes, the smallest first.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE, NO_FIELD), NoSurfaceError: no object has a surface.
    """
    named = _named(objects)
    paths = [one for one in named.values() if isinstance(one, str | os.PathLike)]
    sources = [find_source(Path(one), role="object") for one in paths]
    sources += [find_source(Path(one), role="scene") for one in scenes if isinstance(one, str | os.PathLike)]
    import_smallest_first(sources)
    library, unusable = [], {}
    for name, one in named.items():
        try:
            library.append(_modeled(name, one, options))
        except NoSurfaceError as error:
            unusable[name] = error.reason
    if not library:
        raise NoSurfaceError("no object has a surface", reason="NO_SURFACE_IN_OBJECT")
    return library, unusable


def _named(objects: Objects) -> dict[str, FieldLike | LibraryObject]:
    """The objects by their names. Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE, NO_FIELD)."""
    if isinstance(objects, str | os.PathLike):
        return {str(path): path for path in library_files([Path(objects)])}
    if isinstance(objects, Mapping):
        named: dict[str, FieldLike | LibraryObject] = dict(objects)
    elif isinstance(objects, Sequence):
        named = {}
        for number, one in enumerate(objects):
            name = one.name if isinstance(one, LibraryObject) else f"object {number}"
            named[str(one) if isinstance(one, str | os.PathLike) else name] = one
    else:
        hint = "Give a folder, a list of fields or paths, or a dictionary of them by name."
        raise InvalidInputError(f"the objects are a {type(objects).__name__}", reason="NO_FIELD", hint=hint)
    if not named:
        raise InvalidInputError("the library has no objects", reason="LIBRARY_EMPTY", hint="Give at least one object.")
    return named


def _modeled(name: str, one: FieldLike | LibraryObject, options: RobustOptions) -> LibraryObject:
    if isinstance(one, LibraryObject):
        return one
    if isinstance(one, str | os.PathLike):
        source = find_source(Path(one), role="object")
        return LibraryObject(name, lambda: load_field(source).field, object_model(source, options))
    field = opened(one, "object").field
    return LibraryObject(name, lambda: field, model_object(field, options))


# ``render`` and ``compose`` as users call them.

RenderOptionsLike = RenderOptions | Mapping[str, Any] | None


def render(
    field: FieldLike,
    camera: Camera,
    options: RenderOptionsLike = None,
    progress: Callable[[float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Frame:
    """One frame of a field, or of the field at a path: color or shading, depth, normals, opacity.

    options: RenderOptions, or a dictionary of the options that differ from their defaults. ``cancelled`` is called
    before each tile; if it returns true, CancelledError is raised.
    Raises InvalidInputError: NO_FIELD, CAMERA_INVALID, RENDER_TOO_LARGE, FIELD_NOT_FINITE, COLORS_MISSING; and
    NoSurfaceError (NO_SURFACE_IN_SCENE).
    """
    chosen = _render_options(options)
    return engine_render(opened(field).field, camera, chosen, progress, cancelled)


def compose(
    scene: FieldLike, edits: Sequence[Edit], seed: int = 0, progress: Callable[[float], None] | None = None
) -> EditedScene:
    """Apply edits to a scene (a field or its path). The result is a field. See docs/editing.md.

    Raises InvalidInputError: NO_FIELD, INVALID_TRANSFORM, EDIT_INVALID; and
    NoSurfaceError (NO_SURFACE_IN_OBJECT).
    """
    if not isinstance(edits, Sequence):
        hint = "Write a list: [Removal(box)]."
        raise InvalidInputError("edits must be a list", reason="EDIT_INVALID", hint=hint)
    return engine_compose(opened(scene, "scene").field, edits, seed_of(seed), progress)


def _render_options(options: RenderOptionsLike) -> RenderOptions:
    if options is None or isinstance(options, RenderOptions):
        return options or RenderOptions()
    if isinstance(options, Mapping):
        return RenderOptions.from_dict(dict(options))
    hint = 'Write {"mode": "surface"} or RenderOptions(mode="surface").'
    raise InvalidOptionsError(f"options is a {type(options).__name__}, expected a dictionary", hint=hint)
