"""A registration's result as a user holds it: it prints, draws and saves itself."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.field_notes import FieldNotes
from regnf_core.files import filled_folder
from regnf_core.geometry.box import OrientedBox
from regnf_core.result import RegistrationResult
from regnf_core.verdicts import verdict_in_words
from regnf_core.viewing.artifacts import write_artifacts
from regnf_core.viewing.document import result_document
from regnf_core.viewing.recording import write_recording
from regnf_core.viewing.registration_picture import registration_picture
from regnf_core.viewing.uncertainty import uncertainty
from regnf_core.viewing.window import show

if TYPE_CHECKING:
    from PIL.Image import Image


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
    """The outcome of one registration, with what is needed to show it.

    object_name: the object's path, if it was given by one · notes: what the imports of scene and object said ·
    detection: the box, scene frame.
    """

    object_name: str | None = None
    notes: Mapping[str, FieldNotes] | None = None
    detection: OrientedBox | None = None

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
        """One standard deviation of where the object's center is (``center_scene``, along the scene's x, y, z, scene
        units), of the rotation (``rotation_deg``, about the object's x, y, z) and of the scale (``scale_percent``).
        None from the preset `paper`."""
        if self.covariance is None:
            return None
        return uncertainty(self.covariance, self.T_object_scene, self.center_object)

    def to_dict(self) -> dict[str, Any]:
        """The result document: plain values, as result.json has them."""
        return result_document(self, object_name=self.object_name, fields=self.notes)

    def save(self, folder: str | Path) -> list[Path]:
        """Write result.json, the clouds, the pose and a picture into a folder, as ``regnf register --output`` does."""
        self._require_clouds()
        target = Path(folder)
        if target.exists() and not target.is_dir():
            hint = "Name a folder; it is made if need be."
            raise InvalidInputError(f"{target}: a file, expected a folder", reason="FILE_IS_NO_FOLDER", hint=hint)
        with filled_folder(target) as folder:
            names = write_artifacts(self, folder, object_name=self.object_name, fields=self.notes)
        return [target / name for name in names]

    def plot(self, path: str | Path | None = None, window: bool | None = None) -> Image:
        """The picture of the registration, written to ``path`` too if there is one.

        window: whether a window of PyVista or Open3D is opened, where one of them and a display are there; None: only
        if no ``path`` is given.
        """
        self._require_clouds()
        picture = registration_picture(self)
        if path is not None:
            picture.save(path)
        if window or (window is None and path is None):
            show(self)
        return picture

    def save_recording(self, path: str | Path) -> Path:
        """Write how the registration went as a recording (.rrd) for the viewer of rerun; the path.

        Needs the extra ``rerun``. See docs/how-to/recording.md for what it holds.
        Raises MissingExtraError, InvalidOptionsError, and InvalidInputError (NO_CLOUDS, FILE_IS_FOLDER,
        RECORDING_DISABLED).
        """
        self._require_clouds()
        return write_recording(self, path, self.detection, self.object_name)

    def _require_clouds(self) -> None:
        if not self.residuals:
            hint = "Register without clouds=False."
            raise InvalidInputError("the result has no point clouds to show", reason="NO_CLOUDS", hint=hint)

    def __repr__(self) -> str:
        sure = "" if self.probability is None else f", probability {self.probability:.3f}"
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
        words = f"<b>{escape(self.verdict)}</b>: {escape(reason)} Scale {self.scale:.4g}."
        caption = "<caption>T_scene_object, the object's pose in the scene</caption>"
        return f"<div><p>{words}</p><table>{caption}{rows}</table>{picture}</div>"
