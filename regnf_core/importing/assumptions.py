"""What a reader takes for granted because the file does not say it: its unit, axes, sign and order.

A line begins with its subject. What a reader does not say otherwise is ``UNSAID``, so none is silent; one whose format
defines more gives its own lines. Facts that the file states are no assumptions. Torch- and numpy-free.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from regnf_core.importing.upload_description import UploadDescription

Assumptions = tuple[str, ...]
"""Each a subject of ``SUBJECTS``, a colon and a short sentence."""
SUBJECTS = ("unit", "axes", "sign", "order", "cameras")

UNIT = "unit: not stated in the file; its numbers are used as they are"
AXES = (
    "axes: x, y, z of a right-handed frame; the file states neither that nor which one is up. A left-handed program's "
    "file gives a mirrored shape"
)
SIGN = "sign: positive values are free space; the file does not state it"
FACES = "sign: the surface is open; what its faces look at is free space"
NORMALS = "sign: the normals of the file point to free space"
METERS = "unit: meters, as the format defines; the file itself cannot say it"
"""Of formats with one unit: programs write other ones all the same."""
SCENE = "axes: right-handed, as the format defines; which one is up is not stated"
RUB = "axes: x right, y up, z back, as the format defines; other programs write y down all the same"
LAS = "unit: that of the file's coordinate system, which is not read"

GRID = (
    "order: the axes of the array are x, y, z (with z first the shape is mirrored), and its values are at nodes, the "
    "first at the origin or lowest corner, the last at the highest corner of bounds"
)
INPUTS = "order: the columns of the network's input are x, y, z"

PLACES = (UNIT, AXES)
"""Of points and triangles whose file has numbers alone."""
UNSAID = (UNIT, AXES, SIGN)
"""Of values whose file has numbers alone."""
GLTF = (METERS, "axes: right-handed with y up, as glTF defines; the file itself cannot say it")


def left_open(lines: Assumptions, said: UploadDescription) -> Assumptions:
    """The assumptions that the import options do not settle: each subject once, in the order of ``SUBJECTS``."""
    settled = {"unit": said.world_scale is not None, "sign": said.sign is not None}
    found = {line.partition(":")[0]: line for line in lines}
    return tuple(found[subject] for subject in SUBJECTS if subject in found and not settled.get(subject))
