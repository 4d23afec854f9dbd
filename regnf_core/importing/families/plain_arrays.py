"""A network of plain layers as arrays in a .npz file: matrices and vectors in turn, as JAX, Flax, Keras or numpy do."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from regnf_core.importing.arrays import Float32Array
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import Layers, contradiction, refuse_other_entries, require_family
from regnf_core.importing.families.network import FORM_ENTRIES
from regnf_core.importing.families.plain_network import FAMILY, plain_field
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.tensor_check import MAX_LAYERS

_NAME = re.compile(r"(kernel|weights?|bias(es)?|w|b)", re.IGNORECASE)


def convert(arrays: ArraySource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of one chain of layers, or None where the arrays are something else.

    Raises FieldFormatError: what ArraySource raises, and what the form and the description are refused for.
    """
    names = sorted(arrays.names, key=_in_order)
    if not 3 <= len(names) <= 2 * MAX_LAYERS or not all(_NAME.search(name) for name in names):
        return None
    values = [arrays.array(name) for name in names]
    matrices = [value for value in values if value.ndim == 2]
    vectors = [value for value in values if value.ndim == 1]
    if len(matrices) < 2 or len(matrices) + len(vectors) != len(values) or len(vectors) not in (0, len(matrices)):
        return None
    found = _chain(matrices, vectors, overrides.output_column or 0) or _chain(
        [matrix.T for matrix in matrices], vectors, overrides.output_column or 0
    )
    if found is None:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, FORM_ENTRIES)
    if overrides.output_column is not None and overrides.output_column >= found[1]:
        raise contradiction("output_column", overrides.output_column, f"{found[1]} columns, counted from 0")
    layers = found[0]
    skips = tuple(i for i, extra in enumerate(layers.extra_columns) if extra)
    told = f"{len(matrices)} matrices that continue one another, of {layers.input_width} numbers"
    return replace(plain_field(layers, skips, told, overrides), sign_is_open=overrides.sign is None)


def _chain(weights: Sequence[Float32Array], biases: Sequence[Float32Array], column: int) -> tuple[Layers, int] | None:
    """The layers of matrices (out, in), and how many results the last has; None where they do not fit."""
    if min(min(weight.shape) for weight in weights) < 1:
        return None
    inputs, results = weights[0].shape[1], weights[-1].shape[0]
    for before, after in itertools.pairwise(weights):
        if after.shape[1] - before.shape[0] not in (0, inputs):
            return None
    given = biases or [np.zeros(len(weight), dtype=np.float32) for weight in weights]
    if any(bias.shape != (weight.shape[0],) for bias, weight in zip(given, weights, strict=True)):
        return None
    kept = slice(min(column, results - 1), min(column, results - 1) + 1)
    whole = tuple(np.ascontiguousarray(weight) for weight in (*weights[:-1], weights[-1][kept]))
    return Layers(whole, (*given[:-1], given[-1][kept])), results


def _in_order(name: str) -> list[tuple[int, str]]:
    """Numbers in names by their value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.findall(r"\d{1,9}|\D+", name)]
