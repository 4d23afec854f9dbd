"""One module for each trainer: random settings, the run's files as the trainer leaves them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.trainer_runs.run import WrittenRun
from benchmarks.trainer_runs.trainers import (
    deepsdf,
    instant_nsr_pl,
    nerfstudio,
    neuralangelo,
    neus,
)

Writer = Callable[[Path, np.random.Generator, int], WrittenRun]
"""Takes an empty folder, a source of randomness and the steps of training."""

TRAINERS: dict[str, Writer] = {
    "sdfstudio_neus_facto": nerfstudio.write_sdfstudio_neus_facto,
    "sdfstudio_neus": nerfstudio.write_sdfstudio_neus,
    "sdfstudio_neus_facto_angelo": nerfstudio.write_sdfstudio_angelo,
    "nerfstudio_neus_facto": nerfstudio.write_nerfstudio_neus_facto,
    "neus": neus.write_neus,
    "instant_nsr_pl": instant_nsr_pl.write_instant_nsr_pl,
    "neuralangelo": neuralangelo.write_neuralangelo,
    "deepsdf": deepsdf.write_deepsdf,
}
