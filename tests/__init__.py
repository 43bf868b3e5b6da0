"""Tests of all packages; a package itself so that `tests.faults` can be run from a checkout."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
"""The checkout."""
