"""What each kind of fault does to torque and goals: hold, stand still, open a step, go limp."""

import random
import re
from contextlib import suppress
from functools import partial
from math import copysign
from typing import Any

import pytest

from gripper.errors import (
    BusTimeout,
    FeedbackImplausible,
    FingerSilent,
    ForceAboveCap,
    ForceSensorStale,
    GraspStopped,
    GripperError,
    GripperStateError,
    LimitExceeded,
    PositionContradicted,
    ServoFault,
    copy_fingers,
    fingers_left,
)
from gripper.force.ramp import ForceRamp
from gripper.servos import feedback
from gripper.values.state import GripperPhase
from tests.marks import LONG
from tests.values import raising

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


def test_a_current_that_cannot_be_ends_in_limp_fingers(cell, monkeypatch) -> None:
    cell.hold_part(RAMP)

    def absurd(model, present_a: float, *_of: float) -> tuple[float, float]:
        return 12.0 * present_a, 12.0 * present_a

    observe = cell.once(lambda: monkeypatch.setattr(feedback, "winding_a", absurd), in_s=0.3)
    with pytest.raises(FeedbackImplausible, match=r"at most 1\.50 A are possible"):
        cell.gripper.hold(2.0, observe)
    assert cell.torques == [0, 0]


@pytest.mark.slow
def test_too_much_force_is_lowered_and_the_part_kept(make_cell) -> None:
    cell = make_cell(force_max_n=6.0, rate_hz=200.0)
    cell.hold_part(RAMP)
    observe = cell.once(lambda: setattr(cell.part, "width_m", 0.0124), in_s=0.5)
    with pytest.raises(ForceAboveCap, match="force_max_n is 6"):
        cell.gripper.hold(2.0, observe)
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.5
    peak_n = cell.peak_n
    cell.clock.sleep(1.0)
    assert cell.peak_n <= peak_n + 0.2
    assert cell.torques == [1, 1]
    assert cell.settings.contact_force_n < cell.force_n <= 6.0 < peak_n


def test_force_that_one_pad_shows_alone_lowers_the_currents_by_a_share(make_cell) -> None:
    cell = make_cell(force_max_n=6.0)
    cell.hold_part(RAMP)
    written: list[int] = []
    measure = cell.sensor.measure
    cell.sensor.measure = lambda now_s, true_n: measure(now_s, (2.5 * true_n[0], true_n[1]))
    with pytest.raises(ForceAboveCap, match="force_max_n is 6"):
        cell.gripper.hold(1.0, lambda _: written.append(cell.register(0, "goal_current")))
    cell.clock.sleep(0.5)
    assert 0.4 * abs(written[-1]) < abs(cell.register(0, "goal_current")) < abs(written[-1])
    assert 3.0 < cell.force_n < 4.4


def test_the_other_finger_stands_still_when_a_servo_drops_its_torque(cell) -> None:
    cell.hold_part(RAMP)
    observe = cell.once(cell.servos[1].plant.overload, in_s=0.5)
    with pytest.raises(ServoFault, match="overload") as fault:
        cell.gripper.hold(2.0, observe)
    assert fault.value.torque_lost
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.02
    # The goal is where the finger was, not beyond: it pushes nothing ahead of itself.
    goal, present = cell.register(0, "goal_position"), cell.register(0, "present_position")
    assert abs(goal - present) < 12
    living_m = cell.mechanics.finger_position_m[0]
    cell.part.present = False
    cell.clock.sleep(1.0)
    assert abs(cell.mechanics.finger_position_m[0] - living_m) < 0.0008


# Fingers on their way stop where they are.


class Fails(Exception):
    """What an observer may raise."""


def deaf(cell) -> None:
    cell.gripper.request_stop()
    cell.gripper.bus.sync_write = lambda *_a, **_k: None


IN_THE_WAY = {
    "stop": lambda cell: cell.gripper.request_stop(),
    "fail": lambda _cell: raising(Fails("the disk is full"))(),
    "stall": lambda cell: cell.clock.sleep(0.3),
    "deaf": deaf,
    "silent": lambda cell: cell.device.faults.silent.add(1),
    "dead": lambda cell: cell.device.faults.silent.update((1, 2)),
}
"""What happens while the fingers open fast."""


@pytest.mark.parametrize(
    ("how", "error", "left"),
    [
        ("stop", GraspStopped, "stopped"),
        ("fail", Fails, "stopped"),
        ("stall", LimitExceeded, "stopped"),
        ("silent", FingerSilent, "were seen last"),
        ("deaf", ServoFault, "were seen last"),
        ("dead", BusTimeout, "were seen last"),
    ],
)
@pytest.mark.parametrize("command", ["release", "open"])
def test_fingers_on_their_way_stop_where_they_are(make_cell, command, how, error, left) -> None:
    cell = make_cell(aperture_open_m=0.04)
    if command == "release":
        cell.hold_part(RAMP)
    else:
        cell.gripper.start()

    def observe(cycle) -> None:
        if cycle.phase.moving and cycle.state.aperture_velocity_m_s > 0.03:
            IN_THE_WAY[how](cell)

    with pytest.raises(error) as caught:
        getattr(cell.gripper, command)(observer=observe)
    told = fingers_left(caught.value)
    other = Fails("x")
    copy_fingers(caught.value, other)
    copy_fingers(caught.value, other)
    assert other.__notes__ == [told]
    doing = "letting go" if command == "release" else "opening"
    assert told.startswith(f"the fingers {left} while {doing}, at an opening of ")
    assert ("half held" in told) == (command == "release")
    assert ("watchdog" in told) == (left != "stopped")
    if left != "stopped":
        cell.gripper.keep_grip()
        cell.gripper.close()
    cell.clock.sleep(0.25)
    stood_m = cell.mechanics.aperture_m
    assert stood_m < 0.036
    with suppress(BusTimeout):
        cell.gripper.keep_grip()
    cell.clock.sleep(2.0)
    assert cell.mechanics.aperture_m == pytest.approx(stood_m, abs=3e-4)
    if how in {"stop", "fail"}:
        said_mm = float(re.findall(r"([\d.]+) mm", told)[0])
        assert said_mm == pytest.approx(stood_m * 1e3, abs=1.0)
    if how == "stop":
        expected = GripperPhase.HELD_AFTER_FAULT if command == "release" else GripperPhase.IDLE
        assert cell.gripper.phase is expected
        getattr(cell.gripper, command)()
        assert cell.mechanics.aperture_m == pytest.approx(0.04, abs=1e-3)


def test_a_stop_at_the_begin_of_a_release_lets_nothing_fall(cell) -> None:
    cell.hold_part(RAMP)
    with pytest.raises(GraspStopped):
        cell.gripper.release(lambda _: cell.gripper.request_stop())
    cell.clock.sleep(1.0)
    assert cell.force_n > 0.5
    with pytest.raises(GripperStateError):
        cell.gripper.hold(0.1)
    cell.gripper.release()
    assert cell.force_n == 0.0


def test_silent_servos_do_not_hold_up_the_report_of_another_fault(make_started) -> None:
    """A supply that fails takes pads and servos at once; the pads are named first."""
    cell = make_started(bus_loss_s=0.5)

    def fail() -> None:
        cell.sensor.dead = True
        cell.device.faults.silent.update({1, 2})

    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=3.0))
    asked_s = cell.clock.monotonic()
    with pytest.raises(BusTimeout):
        cell.gripper.keep_grip()
    assert cell.clock.monotonic() - asked_s < 0.02


def test_a_tick_finds_a_tripped_watchdog_too(cell) -> None:
    cell.hold_part(RAMP)
    cell.clock.sleep(1.0)
    with pytest.raises(ServoFault, match="watchdog"):
        [cell.gripper.tick() for _ in range(4)]
    assert cell.force_n > 1.4


def test_a_stuck_finger_is_reported(started) -> None:
    started.gripper.open(0.025)
    for motor in started.motors:
        motor.friction_factor = 50.0
    with pytest.raises(ServoFault, match=r"stuck.*gripper.linkage"):
        started.gripper.open()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(4), *(LONG(seed) for seed in range(4, 200))])
def test_the_force_stays_below_its_cap_with_a_wrong_encoder_at_any_moment(make_cell, seed) -> None:
    """In an approach, a ramp, a hold or a release, of a part or a self-zero, and after it."""
    draw = random.Random(seed)
    kind, cap_n = ("stuck", "jumps", "drifts")[seed % 3], draw.choice((5.0, 15.0, 30.0))
    value = draw.choice((-1.0, 1.0)) * draw.choice((0.02, 0.05, 0.2, 0.5, 1.5))
    kinds: list[dict[str, Any]] = [{}, {}, {"rate_hz": None}, {"n_servos": 1, "linkage": "rack"}]
    cell = make_cell(
        force_max_n=cap_n,
        aperture_m=0.03,
        width_m=draw.choice((0.012, 0.0)),
        **{"rate_hz": 200.0, "noise_n": 0.1} | draw.choice(kinds),
    )
    gripper, ramp = cell.gripper, ForceRamp.linear(0.6 * cap_n, rate_n_s=10.0, hold_s=0.3)
    close = gripper.grasp if cell.part.width_m else gripper.press_pads_together
    gripper.start()
    begin_s, motor = cell.clock.monotonic() + draw.uniform(0.0, 2.5), draw.choice(cell.motors)

    def disturb(now_s: float) -> None:
        if now_s >= begin_s and kind != "stuck":
            motor.encoder_offset_rad = value * (now_s - begin_s if kind == "drifts" else 1.0)
        elif now_s >= begin_s and motor.stuck_at_rad is None:
            motor.stuck_at_rad = motor.angle_rad

    cell.clock.on_advance.append(disturb)
    closing, again = partial(close, ramp), partial(gripper.grasp, ramp)
    hold = partial(gripper.hold, 0.3)
    for command in (closing, hold, gripper.clear_fault, gripper.release, again):
        with suppress(GripperError, ValueError):
            command()
    cell.clock.sleep(0.5)
    assert cell.peak_n <= cap_n


@pytest.mark.slow
@pytest.mark.parametrize("at_n", [0.5, 2.0, 4.0])
@pytest.mark.parametrize("rate_hz", [None, 200.0])
def test_currents_that_freeze_in_a_grip_let_no_part_go(
    make_started, monkeypatch, at_n, rate_hz
) -> None:
    """Else the control lowers the drive until the pads are empty, and reports the part as lost."""
    cell = make_started(rate_hz=rate_hz, stiffness_n_m=5000.0)

    def frozen(_model, present_a: float, *_of: float) -> tuple[float, float]:
        return copysign(0.25, present_a), copysign(0.25, present_a)

    observe = cell.once(lambda: monkeypatch.setattr(feedback, "winding_a", frozen), at_n=at_n)
    with suppress(PositionContradicted):
        cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.5), observe)
        cell.gripper.hold(1.0)
        cell.gripper.hold_at(2.0, 1.0)
    assert cell.force_n > 0.9 * min(at_n, 2.0)
