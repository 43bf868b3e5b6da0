"""A short soak and a short shift: what leaks shows after three blocks, and clients are served."""

import os
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest

from benchmarks.performance import soak, week
from benchmarks.performance.shift import condensed
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.service.history import read_day


def quick_config() -> CellConfig:
    """Two objects and short grasps: what leaks does so in each of them."""
    changes = {
        "gripper.loop_rate_hz": 100.0,
        "gripper.aperture_open_mm": 12.0,
        "gripper.approach_speed_mm_s": 20.0,
        "sequence.ramp": {"kind": "linear", "rate_n_s": 10.0, "hold_s": 0.1},
        "simulator.objects": [entry.model_dump() for entry in CellConfig().simulator.objects[2:4]],
    }
    return changed_config(CellConfig(), changes)


@pytest.mark.long
@pytest.mark.no_cover  # to count lines takes as long again as to run them
@pytest.mark.timeout(600)
def test_some_fifty_grasps_leave_no_file_no_thread_and_few_objects() -> None:
    samples = list(soak.soak(50, quick_config()))
    first, *_, last = samples
    assert last.done >= 50 > samples[-2].done
    assert last.virtual_s > first.virtual_s + 30.0, samples
    assert (last.descriptors, last.threads) == (first.descriptors, first.threads)
    assert last.objects - first.objects < 1.0 * (last.done - first.done) + 50


@pytest.mark.long
@pytest.mark.no_cover
@pytest.mark.timeout(600)
def test_a_shift_of_six_minutes_is_sorted_before_the_eyes_of_its_clients() -> None:
    samples, messages, ledger = condensed(0.1, quick_config())
    assert samples[-1].done == ledger["parts"] + ledger["missed"] == 12
    assert ledger["faults"] == 0
    assert all(messages)
    assert messages[3] < messages[0]
    assert samples[-1].descriptors <= samples[1].descriptors
    assert samples[-1].threads <= samples[1].threads + 1


@pytest.mark.long
@pytest.mark.no_cover
@pytest.mark.timeout(600)
def test_a_day_of_shifts_goes_on_after_each_restart_and_a_leap_of_the_clock(tmp_path: Path) -> None:
    shifts = list(week.week(tmp_path, quick_config(), days=1, n_parts=1))
    assert week.wrong(shifts, n_parts=1) == []
    path = next(tmp_path.glob("history-*"))
    assert [len(read_day(path, date(2027, 3, day))) for day in (1, 2)] == [1 + 3 * 3, 3]
    assert shifts[-1].process.threads == shifts[0].process.threads
    lost = replace(shifts[-1], ledger=shifts[-1].ledger | {"parts": 1}, n_recordings=99)
    assert len(week.wrong([*shifts[:-1], lost], n_parts=1)) == 2


def made(n: int, **growth: float) -> list[soak.ResourceUse]:
    still = soak.ResourceUse(
        done=0, virtual_s=0.0, rss_kib=100_000, objects=80_000, descriptors=9, threads=1
    )
    rows = []
    for i in range(1, n + 1):
        changed = {name: getattr(still, name) + int(20 * i * by) for name, by in growth.items()}
        rows.append(replace(still, done=20 * i, virtual_s=50.0 * i, **changed))
    return rows


@pytest.mark.parametrize(
    ("name", "leak"), [("rss_kib", 1.5), ("objects", 1.0), ("descriptors", 0.05), ("threads", 0.05)]
)
def test_each_kind_of_leak_is_found(name: str, leak: float) -> None:
    assert soak.grown(made(50)) == []
    (told,) = soak.grown(made(50, **{name: leak}))
    assert told.startswith(f"{name} grow by {leak:.4f} each")


def test_one_step_of_the_allocator_is_no_leak() -> None:
    samples = made(50)
    stepped = [*samples[:20], *(replace(s, rss_kib=s.rss_kib + 2000) for s in samples[20:])]
    assert soak.grown(stepped) == []


def test_a_sample_counts_what_is_open() -> None:
    before = soak.look(1, 0.0)
    with Path(os.devnull).open("rb"):
        assert soak.look(1, 0.0).descriptors == before.descriptors + 1
    assert before.rss_kib > 1000
    with pytest.raises(ValueError, match="too few for a slope"):
        soak.slopes([before])
