"""Detections in forms that have another meaning in another program. A box has no report: it is refused, or it is what
was meant."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from regnf_core.detections import Detection, parse_detection, require_in_scene
from regnf_core.errors import InvalidDetectionError

Random = np.random.Generator
_SCENE = ((-4.0, -3.0, -1.0), (4.0, 5.0, 3.0))


def wrong_box(random: Random) -> tuple[str, str, str]:
    """The error, the outcome, and what was said."""
    center = random.uniform((-2.0, -2.0, 0.0), (3.0, 4.0, 2.0))
    size = random.uniform(0.2, 1.5, 3)
    angle = float(random.uniform(0.2, 1.4))
    half = size / 2
    first, last = (
        [math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)],
        [0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)],
    )
    c, s, h = center.tolist(), size.tolist(), half.tolist()
    low, high = (center - half).tolist(), (center + half).tolist()
    factor = float(random.choice([25.4, 39.37, 100.0, 1000.0]))
    turn = [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    forms: dict[str, Any] = {
        "[[center], [size]]": [c, s],
        "[[center], [half]]": [c, h],
        "[[min], [size]]": [low, s],
        "[[min], [max]]": [low, high],
        "corners swapped": {"min": high, "max": low},
        "Unity's extents": {"center": c, "extents": h},
        "Unity's m_Extent": {"m_Center": c, "m_Extent": h},
        "extent without R": {"center": c, "extent": h},
        "half_size": {"center": c, "half_size": h},
        "dimensions": {"center": c, "dimensions": s},
        "size of nuScenes": {"translation": c, "size": s, "rotation": first},
        "four numbers, w first": {"center": c, "size": s, "rotation": first},
        "four numbers, w last": {"center": c, "size": s, "rotation": last},
        "yaw": {"center": c, "size": s, "yaw": angle},
        "yaw in degrees": {"center": c, "size": s, "rotation_y": math.degrees(angle)},
        "rotation transposed and mirrored": {
            "center": c,
            "size": s,
            "rotation": (np.array(turn) * [1, 1, -1]).tolist(),
        },
        "another unit": {"center": (center * factor).tolist(), "size": (size * factor).tolist()},
        "negative size": {"center": c, "size": [s[0], -s[1], s[2]]},
        "decimal comma": {"center": [str(v).replace(".", ",") for v in c], "size": s},
    }
    error = str(random.choice(list(forms)))
    meant = Detection(tuple(c), tuple(s))
    try:
        found = parse_detection(forms[error])
        require_in_scene(found, _SCENE)
    except InvalidDetectionError as refused:
        return error, "refused", refused.reason
    parts = ("center", "size", "rotation_quaternion_xyzw")
    same = all(np.allclose(getattr(found, part), getattr(meant, part), atol=1e-6) for part in parts)
    return error, "harmless" if same else "silent", ""
