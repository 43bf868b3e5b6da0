"""Faults by name: the text form, the vocabulary, and when each begins and ends."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from simulator.boards.flexitac import FlexiTacSettings
from simulator.boards.uskin import UskinBoard, UskinSettings
from simulator.can.drive import DriveMount
from simulator.cell import SimulatedCell
from simulator.errors import SimulatorSettingsError, SimulatorStateError
from simulator.faults.injector import check_fault
from simulator.faults.vocabulary import VOCABULARY
from simulator.servo.control_table import EEPROM_END
from simulator.servo.wrist import WristMount
from simulator.settings import SimulatorSettings
from tactile.layout import pinch_layout


@pytest.fixture
def cell() -> Iterator[SimulatedCell]:
    drive = DriveMount(node_id=11, increments=1e6, start=0.0, low_switch=-0.1, high_switch=0.1)
    axes = {"x": drive, "roll": WristMount(increments=652.0, servo_id=1, zero=0, start=1.0)}
    with SimulatedCell(SimulatorSettings(layout=pinch_layout(), axes=axes)) as made:
        yield made


@pytest.fixture
def board_cell() -> Iterator[SimulatedCell]:
    boards = FlexiTacSettings(rows=6, columns=13)
    with SimulatedCell(SimulatorSettings(layout=pinch_layout(), boards=boards)) as made:
        yield made


@pytest.fixture
def uskin_cell() -> Iterator[SimulatedCell]:
    ids = [range(first, first + 78) for first in (0x300, 0x400)]
    first, second = (UskinBoard(start_id=0x201, taxel_ids=tuple(one)) for one in ids)
    boards = UskinSettings(boards=(first, second))
    with SimulatedCell(SimulatorSettings(layout=pinch_layout(), boards=boards)) as made:
        yield made


def test_a_text_is_name_value_start_and_end() -> None:
    parsed = check_fault("can.loss=0.05@2s..2500ms")
    assert (parsed.entry.name, parsed.value) == ("can.loss", 0.05)
    assert (parsed.event, parsed.start_s, parsed.end_s) == ("", 2.0, 2.5)
    parsed = check_fault(" servo1.stuck@contact+0.5s..contact+0.6s ")
    assert (parsed.event, parsed.start_s, parsed.end_s) == ("contact", 0.5, 0.6)
    for text, event in (("unit.off@moving", "moving"), ("unit.off", "")):
        parsed = check_fault(text)
        assert (parsed.event, parsed.start_s, parsed.end_s) == (event, 0.0, math.inf)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("loss", "not of the form COMPONENT.FAULT"),
        ("can.los", r"no fault 'can.los'; did you mean can.loss\? `tactile-cell simulate --list"),
        ("can.loss=2", r"takes share, 0 to 1, default 0.05; got '2'"),
        ("can.loss=nan", "takes share"),
        ("can.loss=", "no value after its '='"),
        ("can.off=1", "takes no value"),
        ("can.loss@soon", "'soon' is not a time; write 2s, 250ms, contact"),
        ("can.loss@2s..1s", "ends before it begins"),
        ("can.loss@1s..contact", "counts both from different events"),
        ("unit.reboot@1s..2s", "is momentary: leave out its end"),
        ("servo3.off", "this cell has no servo 3, only 2"),
        ("servo0.off", "there is no fault"),
        ("axis3.silence", "this cell has no axis 3, only 2"),
        ("axis2.limit_switch", "for drives, but the axis is a servo"),
        ("unit.emergency=0x10000", "code, 0 to 65535"),
        ("unit.emergency=1.5", "code, 0 to 65535"),
        ("unit.wrong=serial", "takes name:number, for example serial:99"),
        ("unit.wrong=colour:1", "takes one of vendor, product"),
        ("unit.wrong=serial:-1", "does not fit into 32 bits"),
        ("servo1.wrong=goal_current:1", "not an EEPROM register"),
        ("servo1.wrong=current_limit:999999", "outside the range"),
        ("servo1.wrong=model_number:70000", "does not fit into 2 bytes"),
        ("taxels.saturated=2", "pads are 0 to 1"),
        ("taxels.stuck_at=tip:3", "one taxel or a range, for example 3:200 or 3-5:200; got 'tip'"),
        ("taxels.stuck_at=150-156:3", "taxels are 0 to 155, counts 0 to 4095"),
        ("taxels.stuck_at=5:4096", "counts 0 to 4095"),
        ("x" * 300, "at most 200 letters"),
    ],
)
def test_what_is_no_fault_is_refused_and_changes_nothing(cell, text, complaint) -> None:
    with pytest.raises(SimulatorSettingsError, match=complaint):
        cell.inject(text)
    assert cell.injector.faults == ()


@pytest.mark.slow
@given(st.text(max_size=60) | st.from_regex(r"(can|unit|servo1)\.[a-z]+=?[0-9.@a-z+s]*"))
@settings(max_examples=60)
def test_any_text_is_a_fault_or_refused(text) -> None:
    try:
        fault = check_fault(text)
    except SimulatorSettingsError:
        return
    assert fault.text.startswith(fault.entry.name.partition(".")[0].removesuffix("N"))


@pytest.mark.parametrize(
    "name", [*VOCABULARY, "axis2.following_error", "axis2.silence", "axis2.fault", "axis2.reboot"]
)
def test_every_fault_is_injected_and_leaves_no_trace_once_cleared(request, name) -> None:
    fixture = {"board": "board_cell", "uskin": "uskin_cell"}.get(name.partition(".")[0], "cell")
    cell: SimulatedCell = request.getfixturevalue(fixture)
    cell.place("ball")
    cell.clock.sleep(0.1)
    before = _knobs(cell)
    fault = cell.inject(name.replace("servoN", "servo2").replace("axisN", "axis1"))
    assert fault.began_s == cell.clock.monotonic()
    if fault.entry.moment:
        assert fault.over
        return
    cell.clock.sleep(0.01)
    assert cell.injector.faults == (fault,)
    changed = _knobs(cell) != before or name in {"unit.second_node", "object.slips"}
    assert changed, f"{name} turns nothing"
    fault.clear()
    assert fault.over
    fault.clear()
    if name != "object.slips":
        assert _knobs(cell) == before
    assert cell.injector.faults == ()


def _knobs(cell: SimulatedCell) -> Any:
    """Return all that a fault may turn."""
    devices, faults = cell.devices, cell.devices.faults
    wires = [repr(one) for one in (faults.servo_wire, faults.can, faults.unit, faults.boards)]
    if not devices.axes:
        return wires
    serial = devices.unit.pretend("Identity object.Serial number", 1)
    devices.unit.pretend("Identity object.Serial number", serial)
    servos = [
        (
            servo.watchdog_stop,
            servo.injected_error,
            servo.reported_offset_raw,
            servo.registers.data[:EEPROM_END],
            servo.plant.encoder_offset_rad,
            round(servo.plant.temperature_c, 3),
            servo.plant.voltage_v,
        )
        for servo in devices.servo_bus.servos
    ]
    stuck = [(one.stuck_at_rad, round(one.angle_rad, 6)) for one in devices.mechanics.motors]
    press = None if devices.world._press is None else devices.world._press.swell_m
    drive, wrist = devices.axes["x"], devices.axes["roll"]
    axes = [drive.dead, drive.forced_switch, drive.blocked, wrist.blocked]
    axes.append(set(wrist.bus.faults.silent))
    return wires, serial, servos, stuck, press, axes, devices.world.force_gain


def test_the_kinds_are_those_that_fit_the_cell(cell, board_cell, uskin_cell) -> None:
    kinds = set(cell.injector.kinds())
    assert {"can.off", "servo1.off", "servo2.off", "axis1.limit_switch", "axis2.fault"} <= kinds
    assert not kinds & {"servo3.off", "axis2.limit_switch", "axis3.fault", "servoN.off"}
    board_kinds = set(board_cell.injector.kinds())
    assert board_kinds & {"board.off", "unit.off"} == {"board.off"}
    kinds |= board_kinds | set(uskin_cell.injector.kinds())
    assert {name.replace("axis1", "axisN").replace("servo1", "servoN") for name in kinds} >= set(
        VOCABULARY
    )


def test_a_fault_begins_and_ends_at_its_times(cell) -> None:
    cell.clock.sleep(1.0)
    fault = cell.inject("can.loss=0.2@250ms..1s")
    assert fault.began_s is None
    cell.clock.sleep(0.2)
    assert cell.devices.faults.can.drop_rate == 0.0
    cell.clock.sleep(0.06)
    assert cell.devices.faults.can.drop_rate == 0.2
    assert fault.began_s == pytest.approx(1.25, abs=2e-3)
    cell.clock.sleep(1.0)
    assert cell.devices.faults.can.drop_rate == 0.0
    assert fault.over


def test_a_fault_waits_for_the_contact_or_the_motion(cell) -> None:
    cell.place("ball")
    touched = cell.inject("unit.stuck@contact+20ms")
    moved = cell.inject("unit.heartbeat_off@moving")
    cell.clock.sleep(0.2)
    assert (touched.began_s, moved.began_s) == (None, None)
    for motor in cell.devices.mechanics.motors:
        motor.velocity_rad_s = -0.5
    cell.clock.sleep(0.002)
    assert moved.began_s is not None
    cell.devices.world.swell(0.03)
    cell.clock.sleep(0.01)
    assert cell.devices.faults.unit.frozen is False
    began_s = cell.clock.monotonic()
    cell.clock.sleep(0.05)
    assert touched.began_s < began_s + 0.02


def test_two_faults_of_one_knob_of_one_device_are_refused(cell) -> None:
    cell.inject("can.loss=0.1@1s..2s")
    with pytest.raises(SimulatorStateError, match=r"can.loss=0.1@1s..2s is injected and uses"):
        cell.inject("can.loss=0.2@1500ms")
    cell.inject("servo1.supply=9")
    cell.inject("servo2.supply=9")
    cell.inject("servo1.off")
    with pytest.raises(SimulatorStateError, match="same knob"):
        cell.inject("servos.off")
    for unrelated in ("servo1.turned", "taxels.force_gain", "unit.force_gain"):
        cell.inject(unrelated)


def test_a_fault_is_cleared_by_its_text_or_its_name(cell) -> None:
    cell.inject("can.loss=0.5")
    cell.inject("unit.off@3s")
    assert cell.injector.clear("can.loss") == 1
    assert cell.injector.clear("unit.off@3s") == 1
    with pytest.raises(SimulatorStateError, match="is injected; injected faults: none"):
        cell.injector.clear("unit.off")
    cell.inject("can.delayed")
    cell.inject("servos.off")
    cell.injector.clear_all()
    assert cell.devices.faults.can.delay_s == 0.0
    assert cell.devices.faults.servo_wire.silent == set()
