"""Every tuned number of the preset `robust`: its unit, its meaning, and where it comes from.

The source stands in brackets at the end of each entry:

- [derived]: follows from the reason that is given.
- [published]: from the publication that is named.
- [main pairs]: chosen on the eleven main pairs of the benchmark (benchmarks/robust); its held-out pairs are the check.
- [early fits]: introduced for fits to images that were stopped early or show unseen parts (benchmarks/images). Chosen
  by hand there; how the results depend on the value was not recorded.
- [library]: measured on the library of 64 objects of the benchmark (benchmarks/results/robust/library.md).
- [random worlds]: chosen on the parts train and validation of random worlds, each world left out in its turn
  (docs/verdict.md).
- [by hand]: chosen by hand; no tuning and no comparison with other values is recorded.

"Diameters" are diameters of the library object, the length unit of the object's working frame. "Diagonals" are
diagonals of the detection box, the length unit of the scene's working frame. What a user may want to change is an
option, see regnf_core/options.py.
"""

from __future__ import annotations

from regnf_core.robust.constants.model import FEATURES, LIBRARY, MODEL, REFINEMENT, SEARCH, SIGNATURE
from regnf_core.robust.constants.verdict import (
    COVARIANCE,
    EVIDENCE,
    OCCLUSION,
    RELATION,
    SAMPLING,
    SCENE,
    SUPPORT_PLANES,
    VERDICT,
)

__all__ = [
    "COVARIANCE",
    "EVIDENCE",
    "FEATURES",
    "LIBRARY",
    "MODEL",
    "OCCLUSION",
    "REFINEMENT",
    "RELATION",
    "SAMPLING",
    "SCENE",
    "SEARCH",
    "SIGNATURE",
    "SUPPORT_PLANES",
    "VERDICT",
]
