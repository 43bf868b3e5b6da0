"""First force of the wizard: empty, watchdog, 1 N, the cap; nothing moves before it was shown."""

import re
from collections.abc import Iterator

import pytest

from cell.commissioning.engine import WizardAborted
from cell.commissioning.findings import Notes, Verdict
from cell.commissioning.first_force import FIRST_FORCE
from cell.control.self_zero import kept_zeros
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.settings import largest_setpoint_n
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tactile.layout import pinch_layout
from tests.cell.commissioning.conftest import MakeStand, Stand
from tests.marks import LONG

STEP = FIRST_FORCE


@pytest.fixture
def stand(make_stand: MakeStand) -> Stand:
    """A cell of less noise than usual."""
    return make_stand(noise=NoiseModel(level=0.3))


@pytest.fixture(scope="module")
def grasped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stand, Notes]]:
    """A cell after its first grasp, whose pads were checked with weights, and what was found."""
    noise = NoiseModel(level=0.3)
    settings = SimulatorSettings(layout=pinch_layout(), aperture_m=0.014, noise=noise)
    with SimulatedCell(settings) as cell:
        stand = Stand(cell, tmp_path_factory.mktemp("grasped"))
        stand.bench.values["pads_law"] = {"factor": 1.0}
        yield stand, stand.run(STEP, first_force__most=lambda: None)


@pytest.mark.slow
def test_a_sound_cell_makes_its_first_grasp_within_the_force_asked(grasped) -> None:
    stand, finding = grasped
    assert finding.status is Verdict.PASS, finding.lines
    most = next(q for q in stand.person.script.questions if q.key == "first_force.most")
    assert 4.0 < most.default < most.number[1] <= largest_setpoint_n(15.0)
    (first, last) = finding.values["asked_held_peak_n"]
    assert first[:2] == pytest.approx([1.0, 1.0], abs=0.1)
    assert last == pytest.approx(3 * [most.default], rel=0.1)
    assert any("the pads show 0.00 and 0.00 N after a new zero" in line for line in finding.lines)
    assert stand.torques == [0, 0]
    assert len(stand.person.script.writes) == 4
    assert abs(finding.values["meet_mm"]) < 1.0


def kept_drives(stand: Stand) -> list[DriveCharacteristic]:
    """Return what is kept of both servos for the cell."""
    config = stand.bench.config
    kept = kept_zeros(config, stand.bench.folder / config.recording.directory, new_hand=False)
    assert len(kept.drives) == 2
    return list(kept.kept_drives(dict.fromkeys(kept.drives, 0)).values())


@pytest.mark.slow
def test_what_it_measures_of_the_servos_is_kept_for_the_cell(grasped) -> None:
    for drive in kept_drives(grasped[0]):
        assert drive.measured
        assert drive.load_sd < 0.1
        assert drive.kt_per_back_emf is not None


@pytest.mark.slow
@pytest.mark.parametrize("watchdog_ms", [LONG(100.0), 500.0])
def test_the_self_test_of_the_watchdog_closes_no_further_than_was_shown(stand, watchdog_ms) -> None:
    stand.knows(gripper__watchdog_ms=watchdog_ms)
    opened_m = []
    stand.cell.clock.on_advance.append(
        lambda _: opened_m.append(stand.cell.devices.mechanics.aperture_m)
    )
    with pytest.raises(WizardAborted):
        stand.run(STEP, leave_at=["first_force.part"])
    shown = re.fullmatch(r"at most (\S+) mm less.*", stand.person.script.writes[1].after)
    assert 0.0142 - min(opened_m) < 1e-3 * float(shown[1]) < 0.01


@pytest.mark.long
def test_a_person_who_leaves_with_the_part_held_finds_it_held_and_lets_go_next_time(stand) -> None:
    with pytest.raises(WizardAborted, match="keep their grip: take hold of the part"):
        stand.run(STEP, leave_at=["first_force.release"])
    assert stand.torques == [1, 1]
    assert min(stand.cell.world.contact_force_n()) > 0.5
    finding = stand.run(STEP)
    assert stand.person.script.asked[2] == "fingers.held"
    assert finding.status is Verdict.PASS, finding.lines
    # Without weights on the pads the constant of the motor is not kept.
    assert all(drive.kt_per_back_emf is None for drive in kept_drives(stand))


@pytest.mark.parametrize("moment", ["while they open", "while they grasp"])
def test_a_person_stops_a_motion_while_it_runs(stand, moment) -> None:
    looks = 0

    def stop() -> None:
        nonlocal looks
        grasping = "first_force.part" in stand.person.script.asked
        looks += grasping or moment == "while they open"
        if looks == 3:
            raise WizardAborted("stopped at the page")

    with pytest.raises(WizardAborted, match="at the page"):
        stand.run(STEP, moment=stop)
    stood_m = stand.cell.devices.mechanics.aperture_m
    stand.cell.clock.sleep(1.0)
    # Without torque fingers of little friction run on by a millimetre.
    assert stand.cell.devices.mechanics.aperture_m == pytest.approx(stood_m, abs=1.5e-3)
    grasps = "grasp" in moment
    asked = stand.person.script.asked[-1]
    assert asked == ("first_force.part" if grasps else "first_force.empty")
    # Closing fingers may touch a part: they stand where they are until a person lets it go.
    assert stand.torques == ([1, 1] if grasps else [0, 0])


@pytest.mark.slow
def test_fingers_that_find_no_part_fail_the_step(stand) -> None:
    finding = stand.run(STEP, first_force__part=lambda: None)
    assert finding.status is Verdict.FAIL
    assert "The fingers hold nothing (no_contact)" in finding.lines[-1]
    assert stand.torques == [0, 0]
