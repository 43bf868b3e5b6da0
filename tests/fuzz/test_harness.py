"""What the properties rest on: limits that are noticed, damage, and outcomes that are counted."""

import contextlib
from pathlib import Path

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


@pytest.fixture
def properties(monkeypatch: pytest.MonkeyPatch) -> dict[str, harness.Property]:
    """The properties that a test makes, apart from those of the suite."""
    made: dict[str, harness.Property] = {}
    monkeypatch.setattr(harness, "PROPERTIES", made)
    return made


@pytest.mark.usefixtures("properties")
def test_a_property_of_which_nothing_is_learnt_fails() -> None:
    @bad_input(number=st.integers(0, 9))
    def dull(number: int) -> str:
        return "taken"

    with pytest.raises(AssertionError, match="the same became of all inputs"):
        dull()


@pytest.mark.parametrize("made", [True, False])
def test_a_piece_of_a_campaign_is_the_same_in_every_run(
    made: bool, properties: dict[str, harness.Property], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(harness, "SEEDED_PIECE", 30)
    monkeypatch.setattr(harness, "DRAWN_PIECE", 30)
    asked: list[int] = []
    whole = (lambda random: random.randrange(1 << 60)) if made else st.integers(0, 1 << 60)

    @bad_input(number=whole, examples=20)
    def odd(number: int) -> str:
        asked.append(number)
        return "odd" if number % 2 else "even"

    odd()
    assert len(asked) == 20
    ((name, one),) = properties.items()
    assert name == "test_harness.odd"
    assert one.seeded == made
    runs = []
    for number in (4, 4, 5):
        asked.clear()
        piece = one.run(number)
        assert sum(piece.outcomes.values()) == len(asked) == 30
        runs.append(tuple(asked))
    assert runs[0] == runs[1]
    assert len(set(runs[0]) & set(runs[2])) < 10


@pytest.mark.parametrize("made", [True, False])
def test_a_piece_of_a_campaign_names_seed_and_input_of_what_broke(
    made: bool, properties: dict[str, harness.Property], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(harness, "SEEDED_PIECE", 30)
    whole = (lambda random: random.randrange(10)) if made else st.integers(0, 9)

    @bad_input(number=whole)
    def small(number: int) -> str:
        assert number != 7, "seven"
        return "taken"

    (one,) = properties.values()
    failures = one.run(2).failures
    assert failures
    assert all("seed " in text and "seven" in text and "number" in text for text in failures)
    if made:
        assert "seed 6" in failures[0] or "seed 7" in failures[0] or "seed 8" in failures[0]


@pytest.mark.usefixtures("properties")
def test_what_a_property_needs_is_opened_once_and_closed() -> None:
    log: list[str] = []

    @contextlib.contextmanager
    def opened():
        log.append("open")
        yield "thing"
        log.append("close")

    @bad_input(number=st.integers(0, 9), using={"thing": opened})
    def needs(tmp_path: Path, thing: str, number: int) -> str:
        assert tmp_path.is_dir()
        assert (thing, log) == ("thing", ["open"])
        return str(number % 2)

    needs()
    assert log == ["open", "close"]


def test_damage_moves_bytes_and_messages_alike() -> None:
    for kind, left in {"set": b"axc", "put": b"axbc", "cut": b"a", "move": b"bca"}.items():
        damage = (kind, 1, 2, b"x")
        assert spoilt(b"abc", [damage]) == b"".join(disturbed([b"a", b"b", b"c"], [damage])) == left
