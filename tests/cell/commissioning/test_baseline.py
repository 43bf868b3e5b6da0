"""Baseline of the wizard: a gauge object, and what has changed since, with the step it affects."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.checks.changes import (
    Gauge,
    changed_gauge,
    changed_pads,
    changed_servos,
    changed_unit,
    gauge_of,
)
from cell.checks.findings import STORE_NAME, Verdict
from cell.commissioning.baseline import BaselineStep, changed_hardware, gauge_again
from cell.data.formats import COMMISSIONING, write_json
from cell.errors import CellError
from simulator.world.taxels import NoiseModel
from tactile.layout import PadMount, pinch_layout

FOUND: dict[str, Any] = {
    "unit": {"serial_number": 7, "revision": 0x10001},
    "pads_at_rest": {
        "board_serial_numbers": [1, 2],
        "zero_counts": [100.0, 100.0],
        "noise_counts": [80.0, 80.0],
        "bad_taxels": [3],
    },
    "servos": {
        "servos": [
            {"id": 1, "model": "XM430-W350", "firmware": 46},
            {"id": 2, "model": "XM430-W350", "firmware": 46},
        ]
    },
}
SOUND: dict[str, Any] = {"serial": 7, "revision": 0x10001, "boards": (1, 2)}
GAUGE = Gauge(
    gauge="block",
    force_n=4.0,
    held_n=(4.0, 4.0),
    contact_mm=10.2,
    held_mm=9.6,
    current_ma=400.0,
    patch_taxels=(12, 12),
)


def test_the_same_hardware_has_not_changed() -> None:
    assert changed_unit(FOUND, **SOUND) == []
    assert changed_servos(FOUND, {1: ("XM430-W350", 46), 2: ("XM430-W350", 46)}) == []
    assert changed_gauge(GAUGE, replace(GAUGE, contact_mm=10.3, current_ma=430.0)) == []
    rng = np.random.default_rng(0)
    frames = np.clip(rng.normal(100.0, 80.0, (10, 156)), 1, None).astype(np.uint16)
    frames[:, 3] = 0
    assert changed_pads(FOUND, pinch_layout(), frames) == []
    assert changed_unit({}, **SOUND) == changed_servos({}, {1: ("other", 1)}) == []
    assert changed_pads({}, pinch_layout(), frames) == []


@pytest.mark.parametrize(
    ("change", "what", "step"),
    [
        ({"serial": 8}, "control unit", "unit"),
        ({"revision": 0x10002}, "firmware of the control unit", "unit"),
        ({"boards": (1, 9)}, "pads of finger 1", "pads_at_rest"),
        ({"boards": (2, 1)}, "pads", "pads_at_rest"),
    ],
)
def test_another_unit_or_pad_names_the_step(change, what, step) -> None:
    (found,) = changed_unit(FOUND, **SOUND | change)
    assert (found.what, found.step) == (what, step)
    assert f"commission box --redo {step}`" in found.advice(Path("box"))


def test_another_servo_names_its_step() -> None:
    (found,) = changed_servos(FOUND, {1: ("XM430-W210", 46), 2: ("XM430-W350", 46)})
    assert (found.what, found.was, found.step) == ("servo 1", "XM430-W350, firmware 46", "servos")


def test_pads_that_drift_shake_or_break_are_named() -> None:
    rng = np.random.default_rng(0)
    frames = rng.normal(600.0, 80.0, (10, 156))
    frames[:, 78:] = 100.0 + 4.0 * (frames[:, 78:] - 600.0)
    frames = np.clip(frames, 1, None).astype(np.uint16)
    frames[:, 10] = 0
    changes = changed_pads(FOUND, pinch_layout(), frames)
    assert {change.what for change in changes} >= {
        "broken taxels",
        "zero of finger0.inner",
        "noise of finger1.inner",
    }


def test_what_was_found_at_rest_is_compared_taxel_by_taxel_where_pads_are_exchanged() -> None:
    exchanged = (PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0))
    found = {"pads_at_rest": FOUND["pads_at_rest"] | {"zero_counts": [100.0, 700.0]}}
    rng = np.random.default_rng(0)
    frames = rng.normal(700.0, 80.0, (10, 156))
    frames[:, 78:] -= 600.0
    frames = np.clip(frames, 1, None).astype(np.uint16)
    frames[:, 78 + 3] = 0
    assert changed_pads(found, pinch_layout(), frames, exchanged) == []
    (broken, *_) = changed_pads(found, pinch_layout(), frames)
    assert broken.found == "1, new: finger1.inner row 0 column 3"


@pytest.mark.parametrize(
    ("change", "what", "step"),
    [
        ({"held_mm": 9.2}, "opening on the gauge object", "fingers"),
        ({"held_n": (4.5, 3.5)}, "forces of both fingers", "pads_law"),
        ({"current_ma": 600.0}, "current of the motors at the same force", "pads_law"),
    ],
)
def test_a_gauge_object_that_feels_otherwise_names_the_step(change, what, step) -> None:
    (found,) = changed_gauge(GAUGE, replace(GAUGE, **change))
    assert (found.what, found.step) == (what, step)


def test_a_changed_unit_pad_or_servo_is_found_on_the_lines(one) -> None:
    servos = [{"id": n, "model": "XM430-W350", "firmware": 0} for n in (1, 2)]
    one.bench.found = FOUND | {"unit": {"serial_number": 1}, "servos": {"servos": servos}}
    assert {change.what for change in changed_hardware(one.bench)} == {"servo 1", "servo 2"}
    one.bench.found = FOUND | {"servos": {"servos": []}}
    assert [change.what for change in changed_hardware(one.bench)] == ["control unit"]
    one.cell.inject("unit.off")
    one.cell.inject("servos.off")
    assert changed_hardware(one.bench) == []
    one.bench.found = {}
    assert changed_hardware(one.bench) == []


@pytest.mark.slow
def test_the_gauge_object_is_grasped_and_kept_and_a_slipped_horn_shows(stand, tmp_path) -> None:
    one = stand(noise=NoiseModel(level=0.3))
    finding = one.passes(BaselineStep())
    was = gauge_of({"baseline": finding.values})
    assert was.held_n == pytest.approx((was.force_n, was.force_n), rel=0.1)
    assert was.held_mm < was.contact_mm < 11.0
    assert min(was.patch_taxels) > 5
    bench, script = one.bench, one.person.script
    with pytest.raises(CellError, match="no gauge object was kept"):
        gauge_again(bench, bench.config, script)
    kept = {"status": "pass", "lines": [], "values": finding.values, "settings": {}}
    entry = kept | {"figures": {}, "began": "", "ended": ""}
    store = {"steps": {"baseline": entry}, "approved": []}
    write_json(tmp_path / STORE_NAME, COMMISSIONING, store, error=CellError)
    (same,) = gauge_again(bench, bench.config, script)
    assert (same.verdict, same.found) == (Verdict.PASS, "as at commissioning")
    one.cell.inject("servo1.horn=10")
    changed = gauge_again(bench, bench.config, script)
    assert any("--redo fingers" in one.advice for one in changed)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["ball", "cylinder"])
def test_a_gauge_without_parallel_faces_is_refused(one, part) -> None:
    finding = one.run(BaselineStep(), baseline__place=one.does(f"part {part}"))
    assert finding.status is Verdict.FAIL
    assert "but the gauge needs parallel faces: take a block" in finding.lines[-1]
