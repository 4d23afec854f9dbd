"""What a recording holds. The only module that imports rerun.

Everything under ``scene`` is in the scene's frame and units, what is below ``T_scene_object`` in the object's. rerun's
transform of an entity maps its coordinates to its parent's, x_parent = translation + rotation (scale x): it is
T_scene_object itself, scale included.

    scene/samples, scene/surroundings       clouds of the scene
    scene/detection                         the box
    scene/object                            T_scene_object at each step
    scene/object/samples                    the object's samples; at the last step in the colors of their residuals
    scene/considered/N                      T_scene_object of a pose that was judged, N from 0
    scene/considered/N/samples              the samples held out, in the colors of what the scene says there
    residual/scene, residual/object         mean |r| of both sides' samples in each iteration, object units
    course, verdict                         texts

The timeline ``step``: 0 where the refinement began, 1 to n after its iterations (``trace``), n + 1 the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.document import Considered, RegistrationResult, level_in_words
from regnf_core.errors import InvalidInputError, verdict_hint, verdict_in_words
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.viewing.artifacts import CONTEXT_COLOR
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR, residual_colors_of

# The texts of a recording: the verdict as Markdown, and what is said of a pose that was judged.


def verdict_text(result: RegistrationResult, object_name: str | None = None) -> str:
    """Verdict, reason, probability, hint, the transform and the poses that were judged, as Markdown."""
    reason = result.verdict_reason
    lines = [f"# {result.verdict}", "", f"**{reason}**: {verdict_in_words(reason, result.verdict_limit)}", ""]
    if hint := verdict_hint(reason, result.options):
        lines += [hint, ""]
    if object_name is not None:
        lines += [f"Object: `{object_name}`", ""]
    if result.probability is not None:
        sure = f"{_percent(result.probability)}, {level_in_words(result.level)}"
        lines += [f"Probability that the pose is within 5 % of the object's diameter: {sure}", ""]
    lines += ["T_scene_object, the object's pose in the scene (object coordinates to scene coordinates):", "", "```"]
    lines += [" ".join(f"{value: .6f}" for value in row) for row in result.T_scene_object.matrix().tolist()]
    lines += ["```", ""]
    if result.considered is not None:
        lines += ["Candidate poses (`scene/considered`):", "", "| | probability | reason | |"]
        lines += ["|---|---|---|---|"]
        lines += [
            f"| {number} | {_percent(one.metrics.get('probability'))} | {one.reason} | "
            f"{verdict_in_words(one.reason, one.limit)} |"
            for number, one in enumerate(result.considered.poses)
        ]
    return "\n".join(lines)


def _percent(probability: float | None) -> str:
    return "no probability" if probability is None else f"{100 * probability:.1f} %"


TIMELINE = "step"
_BOX_COLOR = (0.25, 0.65, 0.35)
_SIGN_COLORS = np.array([OBJECT_COLOR, (0.82, 0.13, 0.11), (0.48, 0.53, 0.58), (0.98, 0.80, 0.55)])
"""Of the held-out samples: confirmed, in free space, not seen, a little off. See Considered.object_signs."""
_STEPS_A_SECOND = 8.0


def recorded(result: RegistrationResult, detection: OrientedBox | None, object_name: str | None) -> bytes:
    """The content of an .rrd file. Raises InvalidInputError (RECORDING_DISABLED)."""
    stream = rr.RecordingStream("regnf")
    if not rr.is_enabled(stream):
        hint = "Unset the environment variable RERUN, which disables rerun."
        raise InvalidInputError("rerun is disabled", reason="RECORDING_DISABLED", hint=hint)
    memory = stream.memory_recording()
    try:
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.send_blueprint(_layout(result))
        _log_scene(stream, result, detection)
        if result.considered is not None:
            _log_considered(stream, result.considered)
        _log_course(stream, result)
        text = rr.TextDocument(verdict_text(result, object_name), media_type=rr.MediaType.MARKDOWN)
        stream.log("verdict", text, static=True)
        content: bytes = memory.drain_as_bytes()
        return content
    finally:
        stream.disconnect()


def _log_scene(stream: rr.RecordingStream, result: RegistrationResult, detection: OrientedBox | None) -> None:
    """What does not change: the clouds of the scene, the box, and which way is up."""
    if result.options["up_axis"]:
        up = getattr(rr.ViewCoordinates, f"RIGHT_HAND_{result.options['up_axis'].upper()}_UP")
        stream.log("scene", up, static=True)
    stream.log("scene/samples", _points(result.scene_samples.points, SCENE_COLOR), static=True)
    if result.surroundings is not None:
        stream.log("scene/surroundings", _points(result.surroundings.points, CONTEXT_COLOR), static=True)
    if detection is not None:
        box = detection.to_detection()
        shape = rr.Boxes3D(
            centers=[box.center],
            sizes=[box.size],
            quaternions=[rr.Quaternion(xyzw=box.rotation_quaternion_xyzw)],
            colors=[_bytes(np.array(_BOX_COLOR))],
            labels=None if box.label is None else [box.label],
        )
        stream.log("scene/detection", shape, static=True)


def _log_considered(stream: rr.RecordingStream, considered: Considered) -> None:
    """Each pose that was judged, with its probability and reason as a label."""
    for number, one in enumerate(considered.poses):
        entity = f"scene/considered/{number}"
        stream.log(entity, _transform(one.T_scene_object), static=True)
        signs = considered.object_signs[number].cpu().numpy()
        points, colors = _array(considered.object_points), _bytes(_SIGN_COLORS[signs])
        said = f"{_percent(one.metrics.get('probability'))}, {one.reason}"
        samples = rr.Points3D(points, colors=colors, labels=[said], show_labels=True)
        stream.log(f"{entity}/samples", samples, static=True)


def _log_course(stream: rr.RecordingStream, result: RegistrationResult) -> None:
    """The object from step to step, and how far the surfaces are apart."""
    for step, (said, T_object_scene) in enumerate(_course(result)):
        stream.set_time(TIMELINE, sequence=step)
        stream.log("scene/object", _transform(T_object_scene.inverse()))
        stream.log("course", rr.TextLog(said, level=rr.TextLogLevel.INFO))
        if step == 0:
            stream.log("scene/object/samples", _points(result.object_samples.points, OBJECT_COLOR))
        elif step <= len(result.trace):
            record = result.trace[step - 1]
            to_object_units = float(T_object_scene.scale)
            stream.log("residual/scene", rr.Scalars(record.residual_scene))
            stream.log("residual/object", rr.Scalars(record.residual_object * to_object_units))
    colors = _bytes(residual_colors_of(result, "object_residuals"))
    stream.log("scene/object/samples", rr.Points3D.from_fields(colors=colors))


def _course(result: RegistrationResult) -> Iterator[tuple[str, Sim3]]:
    """Each step in words, and T_object_scene there."""
    yield "start of the refinement", result.T_object_scene_initial
    for record in result.trace:
        yield f"iteration {record.iteration}, loss {record.loss:.4g}", record.T_object_scene
    yield f"result: {result.verdict}, {result.verdict_reason}", result.T_object_scene


def _layout(result: RegistrationResult) -> rrb.Blueprint:
    """The scene beside verdict, residuals and course. Poses that were judged are there to be switched on."""
    count = 0 if result.considered is None else len(result.considered.poses)
    hidden: dict[Any, rrb.EntityBehavior] = {
        f"scene/considered/{number}": rrb.EntityBehavior(visible=False) for number in range(count)
    }
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="scene", name="Scene", overrides=hidden),
            rrb.Vertical(
                rrb.TextDocumentView(origin="verdict", name="Verdict"),
                rrb.TimeSeriesView(origin="residual", name="Mean |residual|, object units"),
                rrb.TextLogView(origin="course", name="Course"),
            ),
            column_shares=[2, 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, fps=_STEPS_A_SECOND),
    )


def _transform(T_scene_object: Sim3) -> rr.Transform3D:
    return rr.Transform3D(
        translation=T_scene_object.translation.tolist(),
        quaternion=rr.Quaternion(xyzw=T_scene_object.quaternion_xyzw().tolist()),
        scale=float(T_scene_object.scale),
        relation=rr.TransformRelation.ParentFromChild,
    )


def _points(points: Tensor, color: tuple[float, float, float]) -> rr.Points3D:
    return rr.Points3D(_array(points), colors=_bytes(np.array(color)))


def _array(points: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = points.detach().float().cpu().numpy()
    return array


def _bytes(colors: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colors (..., 3) within 0 and 1 as rerun and PLY files have them."""
    return (255 * colors).round().astype(np.uint8)
