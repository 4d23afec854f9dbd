"""Posed images as sdfstudio keeps them: a folder with ``meta_data.json``, images and depths."""

from __future__ import annotations

from regnf_data.sdfstudio_reader import METADATA, load_dataset
from regnf_data.sdfstudio_writer import check_target, write_dataset

__all__ = ["METADATA", "check_target", "load_dataset", "write_dataset"]
