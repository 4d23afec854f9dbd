"""What each reason of a verdict means, in words. Torch-free: documents, command line and page all tell it from here."""

from __future__ import annotations

VERDICT_REASONS: dict[str, str] = {
    "SURFACES_AGREE": "Both surfaces agree, in both directions, on samples that the refinement has not seen.",
    "SEVERAL_POSES_AGREE": "Several poses explain the data equally well: this one and the alternatives.",
    "LOW_OVERLAP": "Too small a share of the two surfaces agrees.",
    "LARGE_RESIDUAL": "The surfaces stay too far apart where they should coincide.",
    "FREE_SPACE_VIOLATED": "Too much of the object would stand where the scene is free.",
    "SURFACE_UNEXPLAINED": "Close to the object the scene has surface that is no part of it: a look-alike, or something"
    " attached.",
    "SCENE_UNEXPLAINED": "The object explains too little of what stands in the box.",
    "TOO_LITTLE_SURFACE": "Too much of the object would lie within the scene's matter: too little is seen to judge by.",
}
"""By the stable UPPER_SNAKE word that results carry as ``verdict_reason``."""
