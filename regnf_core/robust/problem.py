"""One detection and one object, ready to be registered: both fields, samples to fit, held-out samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

from regnf_core.fields.observation import SdfField
from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import Axis, RobustOptions
from regnf_core.robust.model import ObjectModel
from regnf_core.robust.residuals import SurfacePair
from regnf_core.robust.scene import SceneView
from regnf_core.robust.search.bounds import PoseBound, ScaleBound
from regnf_core.robust.working_frame import fixed_generator, split, working_device


@dataclass(frozen=True, eq=False)
class RegistrationProblem(Bundle):
    """A detection and an object. Poses T (H,) map the scene's working frame to the object's.

    All tensors are on the device that the work is done on, but for the frames and the poses between fields' frames.

    fit: what poses are refined on · held_out: the same fields with other samples, for the verdict alone · bound: what
    is known of a pose.
    """

    view: SceneView
    model: ObjectModel
    fit: SurfacePair
    held_out: SurfacePair
    bound: PoseBound

    def in_field_frames(self, T_work: Sim3) -> Sim3:
        """Poses between the working frames, on the CPU, as T_object_scene."""
        return self.model.frame.to_field() @ T_work @ self.view.frame.to_field().inverse()

    def in_working_frames(self, T_object_scene: Sim3) -> Sim3:
        """A single T_object_scene as a pose between the working frames, on the CPU."""
        return self.model.frame.to_field().inverse() @ T_object_scene @ self.view.frame.to_field()


def make_problem(
    view: SceneView,
    model: ObjectModel,
    scene: SdfField,
    obj: SdfField,
    options: RobustOptions,
    up_axis: Axis | None = None,
) -> RegistrationProblem:
    """Divide the samples of both surfaces into those to fit and those to hold out, on the device of the scene's field.

    The same at every call: seeds of registrations do not move what a pose is judged by.
    An object's field on another device is evaluated there, with a copy of each point and each value.
    """
    device = working_device(scene)
    view, model = view.on(device), (model.with_both_faces if view.of_thing else model).on(device)
    generator = fixed_generator()
    A, A_held = split(view.foreground, options.held_out_share, generator)
    B, B_held = split(model.samples, options.held_out_share, generator)
    scene_field, object_field = view.field(scene), model.field(obj)
    fit = SurfacePair(scene_field, object_field, A, B, view.ahead)
    held_out = SurfacePair(scene_field, object_field, A_held, B_held, view.ahead)
    return RegistrationProblem(view, model, fit, held_out, pose_bound(view, model, options, up_axis))


def pose_bound(view: SceneView, model: ObjectModel, options: RobustOptions, up_axis: Axis | None = None) -> PoseBound:
    """What the detection and the options say of poses between the working frames."""
    scale = ScaleBound.of(options, view.frame.length, model.frame.length)
    bound = PoseBound.of(view.detection, model.extremal_points, options.box_tolerance, scale)
    return replace(bound, seen=view.of_thing, up_axis=up_axis)
