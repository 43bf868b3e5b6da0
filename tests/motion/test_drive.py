"""One CiA 402 drive: set-up, motion, homing, stops, and each way in which it fails."""

from collections.abc import Callable

import can
import pytest
from canopen.profiles.p402 import State402

from motion.errors import (
    AxisAnswerWrong,
    AxisDuplicated,
    AxisFault,
    AxisLimitExceeded,
    AxisMissing,
    AxisNotOperational,
    AxisRestarted,
    AxisSilent,
    HomingFailed,
    LimitSwitchReached,
    PositionImplausible,
    PositionNotReached,
)
from motion.object_dictionary import HomingMethod
from tests.motion.conftest import BOOT_S, NODE, PER_M, DriveBench, MakeDrive
from tests.values import raising

NEAR_M = 5e-5
ENDS = ("Min", "Max")


@pytest.fixture
def bench(make_drive: MakeDrive) -> DriveBench:
    return make_drive()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("homing", "home"),
    [
        (HomingMethod.NEGATIVE_SWITCH, -25_000),
        (HomingMethod.POSITIVE_SWITCH, 25_000),
        (HomingMethod.HERE, 3_000),
        (None, 0),
    ],
)
def test_every_way_of_homing_gives_true_positions(make_drive, homing, home) -> None:
    bench = make_drive(homing=homing, home=home / PER_M)
    bench.simulated._node.sdo["Home offset"].raw = 700  # its sign differs between makers
    for x_m in (-0.02, 0.012):
        assert bench.move(x_m) == pytest.approx(x_m, abs=NEAR_M)
        assert bench.simulated.position == pytest.approx(x_m, abs=NEAR_M)
    gaps_s = [b - a for a, b in zip(bench.supervised, bench.supervised[1:], strict=False)]
    assert max(gaps_s) < 0.02  # the cell is looked after while an axis moves
    bench.drive.prepare(reset=False)  # as after a fault of another axis
    bench.move(0.0)
    assert bench.simulated.position == pytest.approx(0.0, abs=NEAR_M)


def test_a_drive_that_still_moves_is_set_up_once_it_stands(make_drive, monkeypatch) -> None:
    bench, speeds = make_drive(homing=None), list[float]()
    bench.move(-0.02)
    bench.drive.go_to(0.02)
    bench.clock.sleep(0.1)
    assert bench.simulated.motion.speed
    set_up = lambda: speeds.append(bench.simulated.motion.speed)  # noqa: E731
    monkeypatch.setattr(bench.drive, "_set_up", set_up)
    bench.drive.prepare(reset=False)
    assert speeds == [0.0]


def test_a_drive_that_boots_has_its_home_where_it_stands_once_more(make_drive) -> None:
    bench = make_drive(homing=HomingMethod.HERE, home=3e-3)
    bench.move(0.0)
    bench.simulated.power_cycle()
    bench.clock.sleep(BOOT_S)
    with pytest.raises(AxisRestarted, match="has booted"):
        bench.drive.check()
    bench.simulated._zero += 500.0  # it counts from anywhere
    bench.drive.prepare(reset=False)
    assert bench.drive.position == pytest.approx(3e-3, abs=NEAR_M)


@pytest.mark.parametrize("x_m", [0.0201, -0.0201, float("nan"), float("inf")])
def test_nothing_moves_beyond_a_limit(make_drive, x_m) -> None:
    bench = make_drive(homing=None)
    with pytest.raises(AxisLimitExceeded, match=r"limits are -20.00 mm to 20.00 mm; nothing"):
        bench.move(x_m)
    assert bench.simulated.state == "SWITCH ON DISABLED"
    bench.move(0.0)
    with pytest.raises(AxisLimitExceeded):
        bench.drive.go_to(x_m)
    limits = [bench.drive._read(f"Software position limit.{end} position limit") for end in ENDS]
    assert limits == [-20_000, 20_000]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fail", "error", "words"),
    [
        ("fail", AxisFault, "error 2310h: continuous over-current: remedy the cause"),
        ("block", AxisFault, "error 8611h: following error"),
        ("switch", LimitSwitchReached, "stopped by a limit switch at"),
        ("dead", AxisSilent, r"no heartbeat from axis x \(drive 11\) for 0.1"),
        ("empty boot-up", AxisRestarted, "has booted"),
        ("reboot", AxisRestarted, "has booted: its position is lost"),
        ("shut", AxisFault, "left OPERATION ENABLED for READY TO SWITCH ON"),
        ("stopped", AxisNotOperational, "NMT state stopped, .* another CANopen master"),
        ("pre-operational", AxisNotOperational, "NMT state pre-operational, .* another CANopen"),
        ("twice", AxisDuplicated, "SDO answers more than .* a second drive has the same node-ID"),
        (
            "short",
            AxisAnswerWrong,
            "answers wrongly .* \\((6041|1000)h:00\\); 1 bytes came, the object has [24]",
        ),
        ("no state", AxisFault, "left OPERATION ENABLED for UNKNOWN"),
        ("jump", PositionImplausible, r"reads a position of \d{4}.\d\d mm, its limits are -20.00"),
    ],
)
def test_a_drive_that_fails_is_named_and_goes_on_once_it_is_well(bench, fail, error, words) -> None:
    bench.move(-0.01)
    simulated = bench.simulated
    acts = {
        "fail": lambda: simulated.fail(0x2310),
        "block": lambda: setattr(simulated, "blocked", True),
        "switch": lambda: setattr(simulated, "forced_switch", 1),
        "dead": lambda: setattr(simulated, "dead", True),
        "reboot": simulated.power_cycle,
        "empty boot-up": lambda: put(bench, arbitration_id=0x700 + NODE),
        "shut": lambda: simulated._command(State402.CW_SHUTDOWN),
        "stopped": lambda: simulated.command("STOPPED", bench.clock.monotonic()),
        "pre-operational": lambda: simulated.command("PRE-OPERATIONAL", bench.clock.monotonic()),
        "twice": lambda: undo.append(bench.second_drive()),
        "short": lambda: simulated._values.update({"Statusword": b"\x27"}),
        "no state": lambda: simulated._values.update({"Statusword": 1}),
        "jump": lambda: simulated._values.update({"Position actual value": 5_000_000}),
    }
    undo, values = list[Callable[[], None]](), dict(simulated._values)
    bench.once_moving(acts[fail])
    with pytest.raises(error, match=words) as caught:
        bench.move(0.015)
    unseen = fail in ("dead", "twice", "short")
    stopped = "not confirmed to stand still" if unseen else "all axes stand still"
    assert stopped in str(caught.value)
    bench.clock.sleep(0.2)
    assert simulated.dead or not simulated.motion.speed
    if fail in ("twice", "short", "jump"):
        with pytest.raises(error, match=words):
            bench.move(0.005)
    for take_off in undo:
        take_off()
    simulated.blocked = simulated.dead = False
    simulated._values.update(values)
    simulated.forced_switch = 0
    assert bench.move(0.005) == pytest.approx(0.005, abs=NEAR_M)
    assert simulated.position == pytest.approx(0.005, abs=NEAR_M)


def test_a_time_out_of_the_supervision_is_none_of_the_interface(bench) -> None:
    bench.move(0.0)
    bench.drive._client._wait = raising(TimeoutError("servo 2 is silent"))
    with pytest.raises(TimeoutError, match="servo 2"):
        bench.drive._read("Statusword")


@pytest.mark.slow
def test_a_drive_that_another_master_stopped_is_started_by_the_next_motion(bench) -> None:
    bench.move(-0.01)
    bench.simulated.command("STOPPED", bench.clock.monotonic())
    bench.clock.sleep(1.0)
    with pytest.raises(AxisNotOperational, match="NMT state stopped"):
        bench.move(0.0)
    bench.simulated.command("STOPPED", bench.clock.monotonic())
    with pytest.raises(AxisNotOperational, match="NMT state stopped"):
        raise next(iter(bench.axes.inspect().values()))  # type: ignore[misc]
    bench.axes.clear_faults(reboot=False)
    bench.simulated.command("STOPPED", bench.clock.monotonic())
    assert bench.move(0.0) == pytest.approx(0.0, abs=NEAR_M)
    # A master that does so again and again is named, too.
    bench.clock.on_advance.append(lambda now_s: bench.simulated.command("PRE-OPERATIONAL", now_s))
    with pytest.raises(AxisNotOperational, match="pre-operational"):
        bench.move(0.01)
    with pytest.raises(AxisNotOperational, match="sends no heartbeat as operational: look for"):
        bench.move(0.01)


def test_of_two_drives_with_one_node_id_none_is_enabled(bench) -> None:
    bench.second_drive()
    bench.clock.sleep(BOOT_S)
    for _ in range(2):
        with pytest.raises(AxisDuplicated, match=r"axis x \(drive 11\) sent \d+ SDO answers"):
            bench.move(0.0)
        assert bench.simulated.state == "SWITCH ON DISABLED"


def test_an_answer_to_another_question_is_no_silence(bench) -> None:
    bench.move(0.0)
    other = bytes((0x4B, 0x64, 0x60, 0, 0, 0, 0, 0))
    bench.simulated._network._send = lambda t_s, can_id, data: bench.simulated._emit(
        t_s, can_id, other if can_id == 0x580 + NODE else data
    )
    with pytest.raises(AxisAnswerWrong, match=r"answers wrongly \(Statusword .*; Node"):
        bench.move(0.01)


@pytest.mark.slow
def test_a_fault_is_reset_only_by_who_has_seen_it_also_between_two_motions(bench) -> None:
    bench.simulated.fail(0x2342)
    assert "FAULT" in next(iter(bench.axes.inspect().values()))  # type: ignore[operator]
    with pytest.raises(AxisFault, match="error 2342h: current"):
        bench.move(0.0)
    assert bench.simulated.state == "FAULT"
    bench.move(0.0)
    bench.simulated.fail(0xFF07)
    bench.clock.sleep(1.0)
    with pytest.raises(AxisFault, match="error FF07h: device specific"):
        bench.move(0.01)
    bench.move(0.01)
    bench.simulated.power_cycle()
    bench.clock.sleep(1.0)
    with pytest.raises(AxisRestarted, match="has booted: its position is lost"):
        bench.move(0.0)


@pytest.mark.slow
def test_what_the_supervision_raises_stops_the_axis(make_drive) -> None:
    bench = make_drive(homing_velocity=5e-3)
    bench.move(-0.02)

    def supervise() -> None:
        if bench.simulated.motion.speed > 20_000:
            raise KeyError("cancelled")

    with pytest.raises(KeyError):
        bench.axes.move({"x": 0.02}, supervise)
    assert bench.simulated.state == "QUICK STOP ACTIVE"
    bench.clock.sleep(0.1)
    assert not bench.simulated.motion.speed
    assert bench.simulated.position < -0.015
    bench.clock.sleep(1.0)  # the drive misses its host meanwhile, and has stopped already
    began_s = bench.clock.monotonic()
    assert bench.move(-0.02) == pytest.approx(-0.02, abs=NEAR_M)
    assert bench.clock.monotonic() - began_s < 1.0  # it knows its position, and is not homed


def test_a_way_that_takes_too_long_is_stopped(make_drive) -> None:
    bench = make_drive(homing=None, lag=2e3)
    bench.move(0.0)
    bench.simulated.blocked = True
    with pytest.raises(PositionNotReached, match=r"x is at 0.0\d mm instead of 10.00 mm"):
        bench.move(0.01)
    assert not bench.simulated.motion.speed


def test_a_home_that_is_not_found_is_given_up(make_drive) -> None:
    bench = make_drive(lag=2e3)
    bench.simulated.blocked = True
    with pytest.raises(HomingFailed, match="has not found its home"):
        bench.move(0.0)
    assert bench.simulated.state == "QUICK STOP ACTIVE"


def test_who_is_no_drive_or_not_there_is_refused(bench) -> None:
    bench.simulated.dead = True
    with pytest.raises(AxisSilent, match=r"no SDO response .* check supply, CAN cable and node-ID"):
        bench.move(0.0)
    assert isinstance(next(iter(bench.axes.inspect().values())), AxisSilent)
    bench.simulated.dead = False
    bench.simulated._values["Device type"] = 0x0191
    with pytest.raises(AxisMissing, match="device type 00000191h, which is no CiA 402 drive"):
        bench.move(0.0)


def test_a_limit_that_the_drive_does_not_keep_is_refused(bench) -> None:
    bench.simulated._values["Following error window"] = 5
    with pytest.raises(AxisMissing, match=r"keeps 5 in Following error window .* instead of 1000"):
        bench.move(0.0)
    with pytest.raises(AxisMissing, match=r"refused Modes of operation .*limits are narrower"):
        bench.drive._write("Modes of operation", 9)


def test_an_adapter_that_is_gone_is_named(bench) -> None:
    bench.move(0.0)
    bench.bus.faults.unplugged = True
    with pytest.raises(AxisSilent, match=r"CAN interface of the axes failed.*emergency stop"):
        bench.move(0.01)


def test_lost_and_damaged_messages_cost_time_not_the_motion(bench) -> None:
    bench.bus.faults.drop_rate = bench.bus.faults.truncate_rate = 0.05
    for x_m in (0.01, -0.01, 0.0):
        assert bench.move(x_m) == pytest.approx(x_m, abs=NEAR_M)


def put(bench: DriveBench, **frame: object) -> None:
    """Let the host receive a message now."""
    bench.bus._link._inbox.appendleft(can.Message(**{"is_extended_id": False} | frame))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "frame",
    [
        {"arbitration_id": 0x80 + NODE, "data": b"\x10"},
        {"arbitration_id": 0x700 + NODE, "data": b"\x00", "is_error_frame": True},
        {"arbitration_id": 0x700 + NODE, "data": b"\x00", "is_extended_id": True},
        {"arbitration_id": 0x580 + NODE, "data": b"\xff" * 3},
    ],
)
def test_messages_that_are_none_are_passed_over(bench, frame) -> None:
    bench.move(0.0)
    bench.once_moving(lambda: put(bench, **frame))
    assert bench.move(0.01) == pytest.approx(0.01, abs=NEAR_M)


@pytest.mark.parametrize("resumes", [True, False])
def test_a_drive_whose_host_is_gone_stops_by_itself(make_drive, resumes: bool) -> None:
    bench, states = make_drive(homing=None), set[str]()
    bench.simulated.resumes = resumes
    bench.move(-0.02)
    bench.clock.sleep(5.0)  # while it stands, nobody has to send anything
    assert bench.simulated.state == "OPERATION ENABLED"
    bench.drive.go_to(0.02)
    bench.clock.sleep(1.0)
    assert bench.simulated.state == "QUICK STOP ACTIVE"
    assert -0.02 < bench.simulated.position < 0.0
    with pytest.raises(AxisNotOperational, match="its host was silent"):
        bench.move(0.0)
    assert bench.move(0.0) == pytest.approx(0.0, abs=NEAR_M)
    # A motion that was stopped needs no host either, and goes on with torque if it can.
    bench.clock.on_advance.append(lambda _now_s: states.add(bench.simulated.state))
    bench.drive.go_to(0.02)
    bench.axes.stop()
    bench.clock.sleep(5.0)
    assert bench.simulated.nmt_state == "OPERATIONAL"
    assert bench.move(0.0) == pytest.approx(0.0, abs=NEAR_M)
    assert states.isdisjoint({"SWITCH ON DISABLED", "SWITCHED ON"}) == resumes
