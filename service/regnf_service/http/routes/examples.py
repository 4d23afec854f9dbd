"""The contract's examples. Each request here is replayed against the service by a test."""

from __future__ import annotations

from typing import Any

SCENE = "a3" * 32
OBJECT = "7c" * 32
OTHER = "e1" * 32
_BOX = {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]}
_ASKED = {"scene": SCENE, "object": OBJECT, "detection": _BOX}
_WHERE = [[2.0, 0.0, 0.0, 0.3], [0.0, 2.0, 0.0, 0.1], [0.0, 0.0, 2.0, -0.4], [0.0, 0.0, 0.0, 1.0]]
_CAMERA = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]

REGISTER_EXAMPLES: dict[str, Any] = {
    "shortest": {
        "summary": "An axis-aligned box given by its corners, default options",
        "value": _ASKED,
    },
    "oriented": {
        "summary": "An oriented box from a detector, with options and a seed",
        "value": {
            "scene": {"field": SCENE},
            "object": {"field": OBJECT},
            "detection": {
                "center": [-0.15, -0.05, 0.2],
                "size": [0.5, 0.5, 0.4],
                "rotation_quaternion_xyzw": [0.0, 0.0, 0.38268343, 0.92387953],
                "label": "chair",
                "score": 0.91,
            },
            "options": {"up_axis": "z", "robust": {"scene_samples": 6000}},
            "seed": 7,
        },
    },
    "open3d": {
        "summary": "A box in Open3D's form",
        "value": _ASKED
        | {
            "detection": {
                "center": [-0.15, -0.05, 0.2],
                "extent": [0.5, 0.5, 0.4],
                "R": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
            }
        },
    },
    "published": {
        "summary": "The published method (preset `paper`), with options",
        "value": _ASKED
        | {"options": {"preset": "paper", "sampling": {"views": 8}, "optimization": {"iterations": 300}}},
    },
    "library search": {
        "summary": "Search: which of these objects is in the box, and where?",
        "value": {"scene": SCENE, "candidates": [OBJECT, OTHER], "detection": _BOX},
    },
    "warm start": {
        "summary": "With an initial guess, from an earlier result or a robot's odometry",
        "value": _ASKED | {"initial_transform": _WHERE},
    },
    "measured": {
        "summary": "With the true pose: the metrics then have the errors",
        "value": {
            "scene": SCENE,
            "object": OBJECT,
            "detection": {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]},
            "ground_truth": {
                "T_object_scene": [
                    [2.0, 0.0, 0.0, 0.3],
                    [0.0, 2.0, 0.0, 0.1],
                    [0.0, 0.0, 2.0, -0.4],
                    [0.0, 0.0, 0.0, 1.0],
                ]
            },
        },
    },
}

RENDER_EXAMPLES: dict[str, Any] = {
    "substitution": {
        "summary": "The library object in place of the registered one, seen from all sides. Instead of `object` and "
        "transform, an edit may name the `job` that found them",
        "value": {
            "scene": SCENE,
            "edits": [{"kind": "substitution", "object": OBJECT, "T_object_scene": _WHERE}],
            "orbit": {"edit": 0, "frames": 36, "elevation_deg": 20.0},
            "size": [320, 240],
            "outputs": ["color", "strip", "animation"],
        },
    },
    "several edits": {
        "summary": "One object replaced and another one removed, seen from two positions. The edited scene becomes a "
        "field",
        "value": {
            "scene": SCENE,
            "edits": [
                {"kind": "replacement", "object": OBJECT, "T_object_scene": _WHERE, "replacement": OTHER},
                {"kind": "removal", "detection": {"min": [0.4, 0.4, -0.2], "max": [0.8, 0.8, 0.4]}},
            ],
            "look_at": [
                {"position": [2.0, 0.0, 1.0], "target": [0.0, 0.0, 0.0]},
                {"position": [0.0, 2.0, 1.0], "target": [0.0, 0.0, 0.0]},
            ],
            "options": {"mode": "volume"},
            "outputs": ["color", "depth", "mesh", "field"],
        },
    },
    "scene only": {
        "summary": "The scene without edits, seen by the cameras of a transforms.json",
        "value": {
            "scene": SCENE,
            "transforms": {
                "document": {
                    "camera_angle_x": 0.8,
                    "w": 640,
                    "h": 480,
                    "frames": [{"file_path": "0.png", "transform_matrix": _CAMERA}],
                }
            },
            "outputs": ["color", "depth"],
        },
    },
}
