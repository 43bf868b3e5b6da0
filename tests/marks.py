"""Marks of rows in tables of tests."""

from functools import partial

import pytest

LONG = partial(pytest.param, marks=pytest.mark.long)
"""A row of `make test-long`: it repeats what another row asserts, at another place."""
