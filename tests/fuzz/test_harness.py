"""What the properties rest on: limits that are noticed, damage, and outcomes that are counted."""

import contextlib

import pytest
from hypothesis import strategies as st

from tests.fuzz import harness
from tests.fuzz.harness import bad_input, disturbed, limits, spoilt


def hang() -> None:
    while True:
        with contextlib.suppress(Exception):
            pass


def test_an_input_that_hangs_or_takes_memory_is_found() -> None:
    with pytest.raises(AssertionError, match="processor time"), limits(0.02):
        hang()
    with pytest.raises(AssertionError, match="MB of memory"), limits(10.0):
        bytes(b"x" * (80 << 20))


def test_a_property_of_which_nothing_is_learnt_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness, "LONG_RUN", False)

    @bad_input(number=st.integers(0, 9))
    def dull(number: int) -> str:
        return "taken"

    with pytest.raises(AssertionError, match="the same became of all inputs"):
        dull()


def test_a_long_run_asks_in_rounds_of_new_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness, "LONG_RUN", True)
    monkeypatch.setattr(harness, "LONG_EXAMPLES", 90)
    monkeypatch.setattr(harness, "ROUND_EXAMPLES", 30)
    asked = []

    @bad_input(number=st.integers(0, 1 << 60))
    def odd(number: int) -> str:
        asked.append(number)
        return "odd" if number % 2 else "even"

    odd()
    assert 90 <= len(asked) < 120
    assert len(set(asked)) > 60
    monkeypatch.setattr(harness, "LONG_SECONDS", 0.0)
    odd()
    assert 120 <= len(asked) < 150


def test_damage_moves_bytes_and_messages_alike() -> None:
    for kind, left in {"set": b"axc", "put": b"axbc", "cut": b"a", "move": b"bca"}.items():
        damage = (kind, 1, 2, b"x")
        assert spoilt(b"abc", [damage]) == b"".join(disturbed([b"a", b"b", b"c"], [damage])) == left
