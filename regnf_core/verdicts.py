"""What each reason of a verdict means, in words, for result documents, command line and page. Torch-free."""

from __future__ import annotations

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
