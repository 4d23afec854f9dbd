"""The contract's examples. Each request here is replayed against the service by a test."""

from __future__ import annotations

from typing import Any

SCENE = "a3" * 32
OBJECT = "7c" * 32
OTHER = "e1" * 32

REGISTER_EXAMPLES: dict[str, Any] = {
    "shortest": {
        "summary": "An axis-aligned box by its corners; everything else at its default",
        "value": {
            "scene": SCENE,
            "object": OBJECT,
            "detection": {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]},
        },
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
        "summary": "A box as Open3D has it; `centre`, `extents` and `rotation` are taken too",
        "value": {
            "scene": SCENE,
            "object": OBJECT,
            "detection": {
                "center": [-0.15, -0.05, 0.2],
                "extent": [0.5, 0.5, 0.4],
                "R": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
            },
        },
    },
    "published": {
        "summary": "The published method instead, with options of its own",
        "value": {
            "scene": SCENE,
            "object": OBJECT,
            "detection": {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]},
            "options": {"preset": "paper", "sampling": {"views": 8}, "optimization": {"iterations": 300}},
        },
    },
    "library search": {
        "summary": "Which of these objects is it, and where?",
        "value": {
            "scene": SCENE,
            "candidates": [OBJECT, OTHER],
            "detection": {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]},
        },
    },
    "warm start": {
        "summary": "Where to look first, from an earlier result or a robot's odometry",
        "value": {
            "scene": SCENE,
            "object": OBJECT,
            "detection": {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]},
            "initial_transform": [
                [2.0, 0.0, 0.0, 0.3],
                [0.0, 2.0, 0.0, 0.1],
                [0.0, 0.0, 2.0, -0.4],
                [0.0, 0.0, 0.0, 1.0],
            ],
        },
    },
    "measured": {
        "summary": "With the known transform: the metrics then hold the errors",
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
