"""Measures of a point cloud's shape."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist
from torch import Tensor


def diameter(points: Tensor) -> float:
    """The largest distance between any two of the points (N, 3), N >= 1; found among the convex hull's corners."""
    array = points.detach().double().cpu().numpy()
    if array.shape[0] < 2:
        return 0.0
    try:
        array = array[ConvexHull(array).vertices]
    except QhullError:  # flat or tiny clouds have no hull; their own extreme points are few enough below
        directions = np.random.default_rng(0).normal(size=(512, 3))
        heights = array @ directions.T
        array = array[np.unique(np.concatenate([heights.argmin(0), heights.argmax(0)]))]
    return float(pdist(array).max(initial=0.0))
