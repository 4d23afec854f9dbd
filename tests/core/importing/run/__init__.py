"""Tests of regnf_core.importing.run."""
