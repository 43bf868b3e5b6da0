"""First force of the wizard: empty, watchdog, 1 N, the cap; nothing moves before it was shown."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Left, Verdict, carry_out
from cell.commissioning.first_force import FirstForceStep
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tactile.layout import pinch_layout
from tests.cell.commissioning.script import Script, SimulatedLines

BENCH = {
    "gripper.port": "/dev/ttyUSB0",
    "gripper.servos": [
        {"id": 1, "model": "XM430-W350", "direction": 1, "zero_pulse": 2048},
        {"id": 2, "model": "XM430-W350", "direction": 1, "zero_pulse": 2048},
    ],
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "tactile.layout": "pinch",
    "tactile.tare_frames": 10,
    "gripper.aperture_open_mm": 14.0,
    "sequence.ramp": {"kind": "linear", "rate_n_s": 10.0, "hold_s": 0.0},
}


@pytest.fixture
def cell() -> Iterator[SimulatedCell]:
    settings = SimulatorSettings(
        layout=pinch_layout(), noise=NoiseModel(level=0.3), aperture_m=0.014
    )
    with SimulatedCell(settings) as made:
        yield made


def bench_of(cell: SimulatedCell, folder: Path, **found: Any) -> Bench:
    bench = Bench(folder, SimulatedLines(cell))
    bench.settings = BENCH
    bench.found = found
    return bench


def person(cell: SimulatedCell, most_n: float = 4.0, **replies: Any) -> Script:
    def part() -> None:
        cell.place("ball")

    return Script(
        {
            "first_force.most": most_n,
            "first_force.part": part,
            "first_force.empty_again": cell.remove,
        }
        | replies
    )


def torque(cell: SimulatedCell) -> list[int]:
    return [servo.core.registers.get("torque_enable") for servo in cell.devices.servo_bus.servos]


def test_a_sound_cell_makes_its_first_grasp_within_the_force_asked(
    cell: SimulatedCell, tmp_path: Path
) -> None:
    script = person(cell)
    finding = carry_out(FirstForceStep(), bench_of(cell, tmp_path), script)
    assert finding.status is Verdict.PASS, finding.lines
    (one, four) = finding.values["asked_held_peak_n"]
    assert one[:2] == pytest.approx([1.0, 1.0], abs=0.1)
    assert four == pytest.approx([4.0, 4.0, 4.0], abs=0.4)
    assert finding.values["empty_n"] == [0.0, 0.0]
    assert torque(cell) == [0, 0]
    assert len(script.writes) == 4
    assert abs(finding.values["meet_mm"]) < 1.0
    assert finding.figures["force"]["limits"] == {"cap": 15.0}


def test_nothing_moves_that_was_not_shown(cell: SimulatedCell, tmp_path: Path) -> None:
    script = person(cell)
    script.leave_at = ["approve"]
    before = cell.devices.mechanics.aperture_m
    with pytest.raises(Left):
        carry_out(FirstForceStep(), bench_of(cell, tmp_path), script)
    assert cell.devices.mechanics.aperture_m == before


@pytest.mark.long
def test_a_person_who_leaves_with_the_part_held_finds_it_held_and_lets_go_next_time(
    cell: SimulatedCell, tmp_path: Path
) -> None:
    script = person(cell)
    script.leave_at = ["first_force.release"]
    with pytest.raises(Left, match="keep their grip: take hold of the part"):
        carry_out(FirstForceStep(), bench_of(cell, tmp_path), script)
    assert torque(cell) == [1, 1]
    assert min(cell.world.contact_force_n()) > 0.5
    again = person(cell)
    finding = carry_out(FirstForceStep(), bench_of(cell, tmp_path), again)
    assert again.asked[2] == "fingers.held"
    assert finding.status is Verdict.PASS, finding.lines


@pytest.mark.parametrize("moment", ["while they open", "while they grasp"])
def test_a_person_stops_a_motion_while_it_runs(
    cell: SimulatedCell, tmp_path: Path, moment: str
) -> None:
    script = person(cell)
    looks = 0

    def stop() -> None:
        nonlocal looks
        grasping = "first_force.part" in script.asked
        looks += grasping or moment == "while they open"
        if looks == 3:
            raise Left("stopped at the page")

    script.moment = stop
    with pytest.raises(Left, match="at the page"):
        carry_out(FirstForceStep(), bench_of(cell, tmp_path), script)
    stood_m = cell.devices.mechanics.aperture_m
    cell.clock.sleep(1.0)
    assert cell.devices.mechanics.aperture_m == pytest.approx(stood_m, abs=5e-4)
    grasps = "grasp" in moment
    assert script.asked[-1] == ("first_force.part" if grasps else "first_force.empty")
    # Closing fingers may touch a part: they stand where they are until a person lets it go.
    assert torque(cell) == ([1, 1] if grasps else [0, 0])


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("servo1.watchdog_off", "the bus watchdog is not proven to stop the motors: servo 1"),
        ("taxels.stuck_at=20-60:3000", "taxels of pad finger0.inner are bad"),
        ("unit.off", "did not boot"),
        ("servo2.turned", "where the settings exclude it|do not move as|on its own side"),
    ],
)
def test_what_is_wrong_is_named_and_leaves_no_torque(
    cell: SimulatedCell, tmp_path: Path, fault: str, named: str
) -> None:
    cell.inject(fault)
    finding = carry_out(FirstForceStep(), bench_of(cell, tmp_path), person(cell))
    assert finding.status is Verdict.FAIL
    assert any(word in "\n".join(finding.lines) for word in named.split("|")), finding.lines
    assert torque(cell) == [0, 0]


def test_fingers_that_find_no_part_fail_the_step(cell: SimulatedCell, tmp_path: Path) -> None:
    script = person(cell, **{"first_force.part": None})
    finding = carry_out(FirstForceStep(), bench_of(cell, tmp_path), script)
    assert finding.status is Verdict.FAIL
    assert "The fingers hold nothing (no_contact)" in finding.lines[-1]
    assert torque(cell) == [0, 0]


def test_a_gripper_without_pads_presses_by_current(cell: SimulatedCell, tmp_path: Path) -> None:
    cell.inject("unit.off")
    bench = bench_of(cell, tmp_path, unit={"gripper_alone": True})
    finding = carry_out(FirstForceStep(), bench, person(cell, 3.0))
    assert finding.status is not Verdict.FAIL, finding.lines
    assert min(finding.values["asked_held_peak_n"][1]) == pytest.approx(3.0, abs=1.0)
    assert torque(cell) == [0, 0]
