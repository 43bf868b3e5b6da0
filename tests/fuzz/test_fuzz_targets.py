"""Every parser meets some hundred damaged inputs here; `make campaign` feeds it a million."""

import random
from typing import Any

import pytest

from benchmarks import _fuzz_engine, fuzz
from benchmarks._fuzz_engine import BY_CHANCE, Broken, Result, Target, run
from benchmarks._fuzz_mutate import mutated, pieces

SLOW = {"model": 60, "dataset": 200, "recording": 150, "config": 60, "mesh": 150}
SEED = 20


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_no_input_breaks_it(name: str) -> None:
    result = run(fuzz.TARGETS[name], count=SLOW.get(name, 500), seconds=60.0, seed=SEED)
    assert result.failures == []
    assert sum(result.outcomes.values()) == result.inputs > 0
    assert len(result.outcomes) > 1, "inputs must be refused and accepted, or they prove nothing"


class Odd:
    """Accepts, refuses, crashes, hangs or lies, as the input says."""

    def generate(self, rng: random.Random) -> int:
        return rng.randrange(self.kinds)

    def __init__(self, kinds: int) -> None:
        self.kinds = kinds

    def check(self, item: int) -> str:
        if item == 2:
            raise Broken("it lies")
        if item == 3:
            raise KeyError("crash")
        while item == 4:
            pass
        return BY_CHANCE if item == 1 else "fine"


def odd(kinds: int, **limits: Any) -> Result:
    target = Target(name="odd", parser="", inputs="", make=lambda: Odd(kinds), **limits)
    return run(target, count=40, seconds=10.0, seed=1)


def test_crashes_lies_and_hangs_are_found() -> None:
    result = odd(5, limit_s=0.02)
    found = " ".join(result.failures)
    assert "KeyError: 'crash' <- 3" in found
    assert "Broken: it lies <- 2" in found
    assert "Hangs" in found
    assert result.n_failures >= result.outcomes["DEFECT"] > 3


def test_wrong_checksums_are_a_defect_where_they_are_too_many() -> None:
    assert odd(1, crc_tests=1).failures == []
    (failure,) = odd(2, crc_tests=1).failures
    assert "wrong checksums accepted" in failure


def test_a_target_that_takes_too_much_memory_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    peaks_kb = iter((50_000, 50_000 + 17 * 1024))
    monkeypatch.setattr(_fuzz_engine, "_peak_kb", lambda: next(peaks_kb))
    target = Target(name="greedy", parser="", inputs="", make=lambda: Odd(1), growth_mb=16)
    (failure,) = run(target, count=300, seconds=30.0, seed=1).failures
    assert failure == "memory grew by 17 MB"


def test_damage_is_the_same_for_the_same_seed_and_keeps_all_bytes_when_cut() -> None:
    data = bytes(range(40))
    one, two = ([mutated(random.Random(s), data, (data,)) for s in range(60)] for _ in range(2))
    assert one == two
    assert sum(item != data for item in one) > 50
    assert all(b"".join(pieces(random.Random(s), data)) == data for s in range(60))


def test_the_command_prints_a_table_and_says_whether_something_broke(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fuzz.main(["--count", "30", "--jobs", "1", "slcan-adapter"]) == 0
    assert "| slcan-adapter | simulator.slcan |" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        fuzz.main(["nothing"])
    bad = Result(name="shape", inputs=1, wall_s=1.0, n_failures=1, failures=["it lies"])
    monkeypatch.setattr(fuzz, "_results", lambda *_: [bad])
    assert fuzz.main(["shape"]) == 1
    assert "DEFECT in shape: it lies" in capsys.readouterr().out
