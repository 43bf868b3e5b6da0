"""Faults: the grip is kept, the fault latched, nothing is pushed on with."""

import random
from contextlib import suppress
from functools import partial
from math import copysign
from typing import Any

import pytest

from gripper.errors import (
    BusTimeout,
    ForceSensorStale,
    GripperError,
    MechanicsContradicted,
    PositionContradicted,
    ServoFault,
)
from gripper.force.ramp import ForceRamp
from gripper.servos import feedback
from tests.marks import LONG

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)


def test_silent_servos_do_not_hold_up_the_report_of_another_fault(make_started) -> None:
    """A supply that fails takes pads and servos at once; the pads are named first."""
    cell = make_started(bus_loss_s=0.5)

    def fail() -> None:
        cell.sensor.dead = True
        cell.device.faults.silent.update({1, 2})

    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=5.0))
    asked_s = cell.clock.monotonic()
    with pytest.raises(BusTimeout):
        cell.gripper.keep_grip()
    assert cell.clock.monotonic() - asked_s < 0.02


def test_a_tick_finds_a_tripped_watchdog_too(cell) -> None:
    cell.hold_part(RAMP)
    cell.clock.sleep(1.0)

    def tick_for_a_while() -> None:
        for _ in range(4):
            cell.gripper.tick()

    with pytest.raises(ServoFault, match="watchdog"):
        tick_for_a_while()
    cell.gripper.tick()
    assert cell.force_n > 1.4


@pytest.mark.parametrize("first", [True, False])
def test_a_stuck_finger_is_reported(started, first) -> None:
    if not first:
        started.gripper.open(0.025)
    for motor in started.motors:
        motor.friction_factor = 50.0
    with pytest.raises(
        MechanicsContradicted if first else ServoFault,
        match="blocked on its way" if first else r"stuck.*gripper.linkage",
    ):
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
