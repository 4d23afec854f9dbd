"""The pose's covariance.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CovarianceConstants:
    """The pose's covariance (verdict/covariance.py). Checked by benchmarks/results/robust/covariance.md."""

    lengths: tuple[float, ...] = (0.02, 0.03, 0.045, 0.07, 0.1, 0.15, 0.21, 0.3, 0.42, 0.6)
    """Diameters. Correlation lengths that are compared: from the spacing of the samples to half of the object, in steps
    of about 1.5. [derived]"""
    nuggets: tuple[float, ...] = (0.0003, 0.002, 0.01, 0.05, 0.2, 0.7)
    """Shares of the variance without correlation that are compared, in steps of about 5. [derived]"""
    likelihood_samples: int = 160
    """Samples on which lengths and nuggets are compared: the cost grows with their third power. [by hand]"""
    propagated_samples: int = 900
    """Samples through which errors act on the pose: smooth errors almost cancel in some directions, which few samples
    would not show. [by hand]"""
    min_weight: float = 0.3
    """Kernel weight of an inlier. Samples with less belong to something else. [by hand]"""
    regularization: float = 1e-6
    """Relative. Keeps matrices positive definite. [derived: far above float64's precision, far below every nugget]"""
    normals_length: float = 0.6
    """Distance of unit normals, about 35 degrees: how far surfaces may be turned from one another and still be off
    alike. The likelihood of the residuals has its maximum at .35 to .6. [random worlds]"""
    residuals_factor: float = 3.8
    """Of the covariance that the residuals tell. [random worlds, docs/adr/0042-covariance-in-random-worlds.md]"""
    offset_factor: float = 2.3
    """Of the offset between the surfaces, as an error of the pose. [random worlds, the same]"""
    min_variance: float = 1e-18
    """Square diameters. Smallest variance of the errors. [derived: exact fields have residuals of 0]"""


COVARIANCE = CovarianceConstants()
