"""Tests of regnf_core.importing.settings."""
