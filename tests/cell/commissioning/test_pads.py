"""The pads of the wizard: at rest, and pressed by a fingertip; what is wrong is named and set."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Finding, Left, Notes, Verdict, carry_out
from cell.commissioning.pads import (
    PadsAtRestStep,
    PadsPressedStep,
    Patch,
    corner_text,
    judge_rest,
    mounts_of,
    pressed_at,
    rest_of,
)
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.layout import PadMount, TaxelLayout, paper_layout, pinch_layout
from tactile.sensor.calibration import LinearCalibration
from tactile.sensor.tare import TareLimits
from tests.cell.commissioning.script import Script, SimulatedLines

UNIT = {
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "tactile.layout": "pinch",
    "tactile.tare_frames": 30,
}


class Person:
    """Fingertip that presses the pad that was asked for near its corner, or another one."""

    def __init__(
        self, cell: SimulatedCell, other: Callable[[int], int | None] = lambda p: p
    ) -> None:
        self._world, self._layout = cell.devices.physical, cell.settings.layout
        self._other = other
        self.script = Script(moment=self.moment)
        self._names = [pad.name for pad in self._layout.pads]

    def moment(self) -> None:
        last = next((t for t in reversed(self.script.said) if "fingertip" in t), "")
        asked = re.match(r"Press (\S+) with", last)
        pad = self._other(self._names.index(asked[1])) if asked else None
        if pad is None:
            self._world.lift()
        else:
            one = self._layout.pads[pad]
            x_m, y_m = 0.4 * one.rows * one.pitch_x_m, 0.3 * one.columns * one.pitch_y_m
            self._world.press(pad, x_m, y_m, 2.0)


def bench_of(cell: SimulatedCell, folder: Path, **settings: Any) -> Bench:
    bench = Bench(folder, SimulatedLines(cell))
    bench.settings = UNIT | settings
    return bench


def at_rest(tmp_path: Path, *faults: str, layout: TaxelLayout | None = None) -> Finding:
    made = SimulatorSettings(layout=layout or pinch_layout(), faults=faults)
    with SimulatedCell(made) as cell:
        name = "pinch" if layout is None else layout.name
        bench = bench_of(cell, tmp_path, **{"tactile.layout": name})
        return carry_out(PadsAtRestStep(), bench, Script())


def pressed(tmp_path: Path, *faults: str, mounts: tuple[PadMount, ...] = ()) -> Finding:
    made = SimulatorSettings(layout=pinch_layout(), faults=faults, mounts=mounts)
    with SimulatedCell(made) as cell:
        return carry_out(PadsPressedStep(), bench_of(cell, tmp_path), Person(cell).script)


@pytest.mark.parametrize("layout", [None, paper_layout()])
def test_sound_pads_at_rest_pass_without_a_word(tmp_path: Path, layout: Any) -> None:
    finding = at_rest(tmp_path, layout=layout)
    assert finding.status is Verdict.PASS, finding.lines
    assert len(finding.lines) == 1
    assert finding.settings == {"tactile.board_serial_numbers": [1, 2]}
    assert set(finding.figures) == {"zero", "noise"}


@pytest.mark.parametrize(
    ("fault", "status", "named"),
    [
        ("taxels.noisy=1:400", Verdict.WARN, "finger1.inner is noisy: "),
        ("taxels.noisy=1:2000", Verdict.FAIL, "The force of finger1.inner at rest shakes by"),
        ("taxels.stuck_at=3:0", Verdict.WARN, "1 taxel is dead: finger0.inner row 0 column 3"),
        ("taxels.stuck_at=80-81:777", Verdict.WARN, "2 taxels are stuck: finger1.inner row 0"),
        ("taxels.off=0.2", Verdict.FAIL, "taxels of finger0.inner are bad, allowed are 5%"),
        ("taxels.saturated=0", Verdict.FAIL, "78 of 78 taxels of finger0.inner are bad"),
        ("taxels.offset=900", Verdict.FAIL, "No zero can be taken"),
        ("unit.stuck", Verdict.FAIL, "The counts do not move at rest"),
        ("unit.off", Verdict.FAIL, "did not boot"),
    ],
)
def test_what_is_wrong_at_rest_is_named(
    tmp_path: Path, fault: str, status: Verdict, named: str
) -> None:
    finding = at_rest(tmp_path, fault)
    assert (finding.status, named in "\n".join(finding.lines)) == (status, True), finding.lines


def test_boards_that_cannot_be_told_apart_are_a_word_to_the_operator(tmp_path: Path) -> None:
    with SimulatedCell(
        SimulatorSettings(layout=pinch_layout(), board_serial_numbers=(0, 0))
    ) as cell:
        finding = carry_out(PadsAtRestStep(), bench_of(cell, tmp_path), Script())
    assert finding.status is Verdict.WARN
    assert "press each pad after every work" in "\n".join(finding.lines)
    assert finding.settings == {"tactile.board_serial_numbers": None}


def test_pads_where_the_layout_has_them_pass(tmp_path: Path) -> None:
    finding = pressed(tmp_path)
    assert finding.status is Verdict.PASS, finding.lines
    assert finding.settings == {"tactile.mounting": []}


TURNED = [PadMount(pad=p, sent_as=p, rows_mirrored=True, columns_mirrored=True) for p in (0, 1)]
EXCHANGED = [PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0)]


@pytest.mark.parametrize(
    ("fault", "mounts", "named"),
    [
        ("unit.pads_swapped", EXCHANGED, "The pads of the two fingers are exchanged"),
        ("taxels.turned=0", TURNED[:1], "finger0.inner is turned by 180 degrees"),
        (
            "taxels.rows_mirrored=1",
            [PadMount(pad=1, sent_as=1, rows_mirrored=True)],
            "The rows of finger1.inner run the other way",
        ),
        (
            "taxels.columns_mirrored=0",
            [PadMount(pad=0, sent_as=0, columns_mirrored=True)],
            "The columns of finger0.inner run the other way",
        ),
    ],
)
def test_pads_that_sit_otherwise_are_found_named_and_set(
    tmp_path: Path, fault: str, mounts: list[PadMount], named: str
) -> None:
    finding = pressed(tmp_path, fault)
    assert finding.status is Verdict.WARN
    assert named in "\n".join(finding.lines)
    found = [PadMount(**one) for one in finding.settings["tactile.mounting"]]
    assert found == mounts


def test_both_pads_turned_and_exchanged_are_what_the_simulated_cell_has(tmp_path: Path) -> None:
    mounts = (
        PadMount(pad=0, sent_as=1, rows_mirrored=True, columns_mirrored=True),
        PadMount(pad=1, sent_as=0, rows_mirrored=True, columns_mirrored=True),
    )
    finding = pressed(tmp_path, mounts=mounts)
    found = tuple(PadMount(**one) for one in finding.settings["tactile.mounting"])
    assert found == mounts
    assert "force messages cannot be used" not in "\n".join(finding.lines)


def test_a_dead_pad_is_named_and_fails_the_step(tmp_path: Path) -> None:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        person = Person(cell, lambda pad: pad if pad == 1 else None)
        person.script.replies = {"pads_pressed.again": "skip"}
        finding = carry_out(PadsPressedStep(), bench_of(cell, tmp_path), person.script)
    assert finding.status is Verdict.FAIL
    assert "finger0.inner was not seen" in finding.lines[-1]
    assert "No pad showed a fingertip within 30 s" in person.script.text
    assert finding.settings == {}


def test_the_wrong_pad_or_its_middle_is_asked_for_again(tmp_path: Path) -> None:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        wrong = [0, 0, 1]
        person = Person(cell)
        world, press = cell.devices.physical, person.moment
        calls = {"n": 0}

        def moment() -> None:
            press()
            calls["n"] += 1
            last = person.script.said[-1]
            if "Press finger1.inner with" in last and len(wrong) > 1 and calls["n"] > 4:
                world.press(wrong.pop(), 0.0, 0.0, 2.0)

        person.script.moment = moment
        finding = carry_out(PadsPressedStep(), bench_of(cell, tmp_path), person.script)
    assert finding.status is Verdict.PASS, finding.lines


def test_leaving_while_a_pad_is_pressed_ends_the_step(tmp_path: Path) -> None:
    def leave() -> None:
        raise Left("left")

    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell, pytest.raises(Left):
        carry_out(PadsPressedStep(), bench_of(cell, tmp_path), Script(moment=leave))


def test_corners_are_named_as_a_person_sees_them() -> None:
    layout = paper_layout()
    names = [pad.name for pad in layout.pads]
    for name, words in {
        "finger0.inner": "near the tip and at the left edge",
        "finger1.inner": "near the tip and at the right edge",
        "finger0.tip": "at the edge towards the other finger and on the left",
    }.items():
        assert corner_text(layout, names.index(name)).startswith(words)


def test_a_full_scale_below_the_forces_of_the_sequence_is_a_word_to_the_operator() -> None:
    layout = pinch_layout()
    frames = np.random.default_rng(0).normal(100.0, 20.0, (30, 156)).astype(np.uint16)
    rest = rest_of(layout, LinearCalibration(0.0001, layout.adc_max), frames)
    limits: dict[str, Any] = {"limits": TareLimits(), "contact_force_n": 0.3}
    judge_rest(layout, frames, rest, notes := Notes(), most_force_n=8.0, **limits)
    assert notes.status is Verdict.WARN
    assert notes.lines[0].startswith("A small part saturates finger0.inner at 3.2 N")
    judge_rest(layout, frames, rest, notes := Notes(), most_force_n=3.0, **limits)
    assert notes.lines == []


def test_places_and_mounts_of_patches() -> None:
    layout = paper_layout()
    force_n = np.zeros(layout.n_taxels)
    assert pressed_at(layout, force_n) is None
    force_n[layout.taxels_of(2).start] = 1.0
    patch = pressed_at(layout, force_n)
    assert patch is not None
    assert (patch.pad, patch.force_n) == (2, 1.0)
    assert (patch.along, patch.across) == pytest.approx((-15 / 16, -1 / 2))
    found = mounts_of(layout, {2: patch, 0: Patch(pad=0, along=0.8, across=0.4, force_n=1.0)})
    assert found == (PadMount(pad=2, sent_as=2, rows_mirrored=True, columns_mirrored=True),)
