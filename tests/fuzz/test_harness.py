"""What the properties rest on: limits that are noticed, and outcomes that are counted."""

import contextlib

import pytest
from hypothesis import strategies as st

from tests.fuzz.harness import bad_input, limits


def test_an_input_that_hangs_or_takes_memory_is_found() -> None:
    def hang() -> None:
        while True:
            with contextlib.suppress(Exception):
                pass

    with pytest.raises(AssertionError, match="processor time"), limits(0.02):
        hang()
    with pytest.raises(AssertionError, match="MB of memory"), limits(10.0):
        bytes(b"x" * (80 << 20))


def test_a_property_of_which_nothing_is_learnt_fails_and_what_breaks_is_shown() -> None:
    @bad_input(number=st.integers(0, 9))
    def broken(number: int) -> str:
        return "taken" if number < 8 else str(1 // (9 - number))

    with pytest.raises(ZeroDivisionError) as found:
        broken()
    assert "number=9" in "".join(found.value.__notes__)

    @bad_input(number=st.integers(0, 7))
    def taken(number: int) -> str:
        return "taken"

    with pytest.raises(AssertionError, match="the same became of all inputs"):
        taken()
