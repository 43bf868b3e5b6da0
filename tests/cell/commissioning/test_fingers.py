"""Fingers of badly mounted servos: linkage, directions and zeros by hand, the first motion."""

import re
from math import asin, radians, sin
from typing import Any

import pytest

from cell.commissioning.engine import WizardAborted
from cell.commissioning.findings import Verdict
from cell.commissioning.fingers import FINGERS, KINDS, fit_linkages
from cell.commissioning.servos import SERVOS
from cell.config.file import changed_config
from gripper.servos.goal_limits import GoalWriter
from simulator.servo.mechanics import RackLinkage, ServoMount
from simulator.settings import SimulatedServoSettings
from tests.cell.commissioning.conftest import MakeStand, Stand
from tests.marks import LONG

STEP = FINGERS
BLOCKS_M = (0.010, 0.030)


def on_parallel(size_m: float, link_m: float, closed_rad: float = 0.0) -> float:
    """Return the angle of links on a block."""
    return asin(size_m / 2 / link_m + sin(closed_rad)) - closed_rad


PARALLEL = [on_parallel(m, 0.03) for m in BLOCKS_M]
ASKEW = [on_parallel(m, 0.04, radians(35)) for m in BLOCKS_M]


@pytest.mark.parametrize(
    ("angles_rad", "sizes_m", "best"),
    [
        (PARALLEL, BLOCKS_M, "parallel"),
        ([m / 2 / 0.01 for m in BLOCKS_M], BLOCKS_M, "pinion"),
        (ASKEW, BLOCKS_M, "swinging"),
        # Long links hardly turn, and one block fits every kind: the person decides.
        ([on_parallel(m, 0.06) for m in BLOCKS_M], BLOCKS_M, None),
        (PARALLEL[1:], BLOCKS_M[1:], None),
    ],
)
def test_each_kind_of_linkage_is_found_where_the_measurements_tell_them_apart(
    angles_rad, sizes_m, best
) -> None:
    fits, kind = fit_linkages([[angle, angle] for angle in angles_rad], sizes_m)
    assert kind == best
    assert list(fits) == [*KINDS][: 1 + len(sizes_m)]
    fit = fits[best or "parallel"]
    assert fit.linkage.aperture_m([fit.closed_rad] * 2) == pytest.approx(0.0, abs=1e-6)
    on_block_rad = fit.closed_rad + angles_rad[0]
    assert fit.linkage.aperture_m([on_block_rad] * 2) == pytest.approx(sizes_m[0], abs=1e-6)


def with_servos_set_up(make_stand: MakeStand, *faults: str) -> Stand:
    stand = make_stand(*faults, aperture_m=0.03)
    for servo in stand.cell.devices.servo_bus.servos:
        servo.registers.put("operating_mode", 5)
    return stand


@pytest.fixture
def stand(make_stand: MakeStand) -> Stand:
    return with_servos_set_up(make_stand)


def test_one_servo_with_a_pinion(make_stand) -> None:
    stand = make_stand(
        servos=(SimulatedServoSettings(servo_id=1, mount=ServoMount(direction=-1)),),
        linkage=RackLinkage(pinion_radius_m=0.02),
    )
    servos = stand.run(SERVOS, servos__count="1").settings
    stand.bench.settings = {**stand.bench.settings, **servos}
    notes = stand.passes(STEP, fingers__kind="pinion")
    assert "fingers.open_second" not in stand.person.script.asked
    assert notes.settings["gripper.servos"][0]["direction"] == -1
    linkage = notes.settings["gripper.linkage"]
    assert linkage["kind"] == "rack_pinion"
    assert linkage["pinion_radius_mm"] == pytest.approx(20.0, rel=0.02)


def test_directions_zero_and_linkage_of_badly_mounted_servos(make_stand) -> None:
    stand = with_servos_set_up(make_stand, "servo2.turned", "servo1.horn=164")
    second_first = {"Open one finger": ("open 1", ""), "open the other": ("open 0", "")}
    notes = stand.passes(STEP, practice=second_first)
    first, second = notes.settings["gripper.servos"]
    assert (first["id"], first["direction"]) == (2, -1)
    assert (second["id"], second["direction"]) == (1, 1)
    assert second["zero_pulse"] == pytest.approx(2048 + 164, abs=2)
    assert first["zero_pulse"] == pytest.approx(2048, abs=2)
    linkage = notes.settings["gripper.linkage"]
    assert linkage["kind"] == "parallel_linkage"
    assert linkage["link_mm"] == pytest.approx(60.0, rel=0.02)
    assert notes.values["residual_mm"] < 0.3
    inverted, mounted = notes.corrected
    assert inverted == "servo 2 turns the other way: its direction was +1, is now -1"
    assert "servo 1: its horn sits +14.4 deg off: its zero was 2048 pulses, is now 221" in mounted
    assert "opened by" in "\n".join(notes.lines)
    assert stand.torques == [0, 0]
    assert stand.person.script.watched


def test_a_wrong_linkage_and_opening_of_the_config_are_named(stand) -> None:
    wrong = {
        "gripper.linkage": {"kind": "rack_pinion", "pinion_radius_mm": 40.0},
        "gripper.aperture_open_mm": 150.0,
        "gripper.contact_timeout_s": 11.0,
    }
    stand.bench.base = changed_config(stand.bench.base, wrong)
    stand.bench.settings = {k: v for k, v in stand.bench.settings.items() if "aperture" not in k}
    linkage, opening = stand.passes(STEP).corrected
    assert "the linkage was rack_pinion, pinion_radius_mm 40" in linkage
    assert "is now parallel_linkage, link_mm 60." in linkage
    assert opening.startswith("gripper.aperture_open_mm was 150, is now 11")


@pytest.mark.parametrize("tight", ["close", LONG("open")])
def test_a_first_motion_begins_with_room_on_both_sides(stand, tight) -> None:
    stand.passes(STEP, fingers__free=[stand.person.does("empty", tight), stand.person.does("half")])
    assert stand.person.script.asked.count("fingers.free") == 2


@pytest.mark.long
def test_stiff_servos_pass_the_first_motion(stand) -> None:
    for motor in stand.cell.devices.mechanics.motors:
        motor.friction_factor = 2.0  # 3.3 times the catalogue for servo 2, 4.1 are plausible
    stand.passes(STEP)


def pinched(stand: Stand) -> None:
    stand.cell.devices.mechanics.motors[1].friction_factor = 22.0


def drifting(stand: Stand) -> None:
    stand.cell.inject("servo1.drift=-0.2")


@pytest.mark.parametrize(
    ("key", "reply", "named"),
    [
        # Both move from half way.
        ("close", "half", "servo 1 by 50.4 deg, servo 2 by 29.5"),
        ("open_second", "", r"moved by \d pulses only"),
        # Something was between the pads when they were to touch.
        ("close", "block 20", r"finger 0 by 4\.[6-9] deg, finger 1 by 4\.[6-9] deg"),
        LONG("free", pinched, r"finger 1 \(servo 2\): did not move"),
        ("free", drifting, r"finger 0 \(servo 1\): closed instead of opening"),
        ("opened", "no", "what the servos report and what the fingers do differ"),
    ],
)
def test_fingers_that_do_not_move_as_asked_fail_the_step_and_are_limp(
    stand, key, reply, named
) -> None:
    answers = {f"fingers.{key}": stand.person.does(reply) if reply else lambda: None}
    if reply == "half":
        answers["fingers.open_first"] = stand.person.does("close", "open 0")
    if key == "free":
        answers["fingers.free"] = lambda: (stand.person.does("empty", "half")(), reply(stand))
    notes = stand.run(STEP, **(answers if key != "opened" else {"fingers.opened": reply}))
    assert notes.status is Verdict.FAIL
    assert re.search(named, notes.lines[-1])
    assert notes.settings == {}
    assert stand.torques == [0, 0]
    moved = key in ("free", "opened")
    assert bool(stand.person.script.writes) == moved
    if not moved:
        stand.passes(STEP)


def test_no_linkage_is_proposed_where_the_measurements_do_not_tell(stand) -> None:
    with pytest.raises(AssertionError, match="no reply"):
        stand.run(STEP, practice={"How do the fingers move": ("", "")})
    (question,) = [
        question for question in stand.person.script.questions if question.key == "fingers.kind"
    ]
    assert question.default is None
    assert list(question.choices) == list(KINDS)
    for kind, text in question.choices.items():
        assert text.endswith(KINDS[kind].partition("\n")[2])


def test_a_thickness_that_was_typed_wrong_is_found(stand) -> None:
    replies: dict[str, Any] = {
        "fingers.on_block2": stand.person.does("block 30"),
        "fingers.kind": "parallel",
    }
    notes = stand.run(STEP, fingers__block2=50.0, **replies)
    assert notes.status is Verdict.FAIL
    assert "was a thickness typed wrong" in notes.lines[0]
    assert "fingers.free" not in stand.person.script.asked
    # A smaller error warns.
    notes = stand.run(STEP, fingers__block2=33.0, **replies)
    assert notes.status is Verdict.WARN
    assert "the residual is above 0.5 mm: measure the blocks again" in "\n".join(notes.lines)


def test_one_block_is_enough_and_worth_a_word(stand) -> None:
    notes = stand.run(STEP, fingers__block2=0.0)
    assert notes.status is Verdict.WARN
    assert notes.settings["gripper.linkage"]["link_mm"] == pytest.approx(60.0, rel=0.05)


def test_leaving_at_each_question_leaves_no_torque(stand) -> None:
    stand.run(STEP)
    for place in [*stand.person.script.asked, "approve"]:
        with pytest.raises(WizardAborted):
            stand.run(STEP, leave_at=[place])
        assert stand.torques == [0, 0], place


def test_an_interruption_of_the_first_motion_leaves_the_fingers_limp(stand, monkeypatch) -> None:
    write, seen = GoalWriter.write, []

    def interrupted(writer: GoalWriter, goals: Any, state: Any) -> None:
        seen.append(stand.torques)
        if len(seen) > 20:
            raise KeyboardInterrupt
        write(writer, goals, state)

    monkeypatch.setattr(GoalWriter, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stand.run(STEP)
    assert seen[-1] == [1, 1]
    assert stand.torques == [0, 0]
