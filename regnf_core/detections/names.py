"""The names that a detection's members have in the wild: those that are taken, and what to write for the others."""

from __future__ import annotations

CANONICAL = {
    "center": "center",
    "centre": "center",
    "size": "size",
    "extent": "size",  # Open3D
    "extents": "size",  # trimesh
    "rotation": "rotation",
    "R": "rotation",  # Open3D
    "rotation_matrix": "rotation",
    "rotation_quaternion_xyzw": "rotation_quaternion_xyzw",
    "rotation_quaternion_wxyz": "rotation_quaternion_wxyz",
    "min": "min",
    "min_bound": "min",  # Open3D
    "max": "max",
    "max_bound": "max",  # Open3D
    "label": "label",
    "score": "score",
}
"""Each name that is taken, and the member that it stands for."""

ROTATIONS = ("rotation", "rotation_quaternion_xyzw", "rotation_quaternion_wxyz")

OPEN3D_NAMES = frozenset({"extent", "R", "min_bound", "max_bound"})
OPEN3D_EXTRA = frozenset({"class_name", "color", "version_major", "version_minor"})
"""Members of Open3D's documents that say nothing about the box."""

NUSCENES_NAMES = frozenset({"translation", "size", "rotation"})
"""Together they name nuScenes' form."""
NUSCENES_LABELS = ("detection_name", "tracking_name", "category_name")
NUSCENES_SCORES = ("detection_score", "tracking_score")
NUSCENES_EXTRA = frozenset(
    {
        "token",
        "sample_token",
        "instance_token",
        "visibility_token",
        "attribute_tokens",
        "attribute_name",
        "tracking_id",
        "velocity",
        "ego_translation",
        "num_pts",
        "num_lidar_pts",
        "num_radar_pts",
        "prev",
        "next",
    }
)
"""Members of nuScenes' records that say nothing about the box."""

_ORDER = (
    "Say the order of the quaternion: `rotation_quaternion_xyzw` (ROS, SciPy) or `rotation_quaternion_wxyz` (Eigen's "
    "constructor, nuScenes, COLMAP)."
)
_TURN = "A rotation by the angle a about z is `rotation_quaternion_xyzw`: [0, 0, sin(a/2), cos(a/2)]."
_HALF = "Write `size`: the full edge lengths, twice these."
_CORNERS = "Write the lowest and the highest corner: `min`: [x, y, z] and `max`: [x, y, z]."
INSTEAD = {
    "quaternion": _ORDER,
    "rotation_quaternion": _ORDER,
    "orientation": _ORDER,
    "quat": _ORDER,
    "qvec": _ORDER,
    "yaw": _TURN,
    "heading": _TURN,
    "rotation_y": _TURN,
    "rotation_z": _TURN,
    "angle": _TURN,
    "euler": "Write `rotation` as a 3x3 matrix: Euler angles do not say their order.",
    "half_extents": _HALF,
    "half_extent": _HALF,
    "half_size": _HALF,
    "dimensions": "Datasets order dimensions differently. Write `size`: [x, y, z], the full edge lengths.",
    "wlh": "Write `size`: [x, y, z], the full edge lengths; for nuScenes' boxes that is [length, width, height].",
    "lwh": "Write `size`: [x, y, z], the full edge lengths along the box's own axes.",
    "hwl": "Write `size`: [x, y, z], the full edge lengths along the box's own axes.",
    "bounds": _CORNERS,
    "bbox": _CORNERS,
    "box": _CORNERS,
    "aabb": _CORNERS,
    "corners": _CORNERS,
    "vertices": _CORNERS,
    "lower": "Did you mean `min`?",
    "upper": "Did you mean `max`?",
    "position": "Did you mean `center`?",
    "location": "Did you mean `center`?",
    "translation": "Did you mean `center`? nuScenes' form has `translation`, `size` [width, length, height] and "
    "`rotation` [w, x, y, z], all three.",
    "class": "Did you mean `label`?",
    "name": "Did you mean `label`?",
    "category": "Did you mean `label`?",
    "confidence": "Did you mean `score`?",
    "probability": "Did you mean `score`?",
}
"""What to write for names that are not taken: most of them do not say enough."""

FORMS = (
    'Write {"min": [x, y, z], "max": [x, y, z]} or {"center": [x, y, z], "size": [x, y, z], "rotation": [[3], [3], '
    "[3]]}, in the scene's frame and units. docs/api.md lists every form."
)
