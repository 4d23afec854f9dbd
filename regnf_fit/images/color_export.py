"""The color of a fitted field as a safe field keeps it: a network that follows the geometry's."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.schema.color import DirectionEncoding, NetworkColor, color_tensors
from regnf_fit.images.network import COLOR_INPUTS, DIRECTION_DEGREE, RadianceField

_FORM = NetworkColor("network", direction=DirectionEncoding("frequency", DIRECTION_DEGREE), gradient="unit")


def stored_color(field: RadianceField) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """The description's entry, and the tensors by their names in the file.

    No activation stands between the geometry's feature and the color's first layer: they are one layer of the file.
    """
    weights = [_double(weight) for weight in field.color_weights]
    biases = [_double(bias) for bias in field.color_biases]
    own, features = weights[0][:, :COLOR_INPUTS], weights[0][:, COLOR_INPUTS:]
    weights[0] = np.concatenate((own, features @ _double(field.feature_weight)), axis=1)
    biases[0] = biases[0] + features @ _double(field.feature_bias)
    layers = {f"layers.{i}.weight": weight.astype(np.float32) for i, weight in enumerate(weights)}
    layers |= {f"layers.{i}.bias": bias.astype(np.float32) for i, bias in enumerate(biases)}
    return asdict(_FORM), color_tensors(layers)


def _double(tensor: Tensor) -> NDArray[np.float64]:
    values: NDArray[np.float64] = tensor.detach().double().cpu().numpy()
    return values
