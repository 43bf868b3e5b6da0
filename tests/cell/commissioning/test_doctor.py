"""The system check: findings that say what to do, and a machine that is left as it was."""

import contextlib
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cell.commissioning.doctor
from cell.build import build_cell
from cell.commissioning.doctor import Commissioning, _load, examine
from cell.commissioning.findings import Finding, Verdict
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.errors import CellError
from cell.files import COMMISSIONING, write_json
from cell.simulation import simulation_of
from tactile.source import SourceIdentity
from tests.cell.cells import once, small_config
from tests.faults.campaign import CHANGES, ROTATION_AXIS, WRIST, X_AXIS

PASS, WARN, FAIL = Verdict.PASS, Verdict.WARN, Verdict.FAIL
REAL = {
    "gripper__port": "/dev/serial-that-is-not-there",
    "tactile__interface": "slcan",
    "tactile__channel": "/dev/can-that-is-not-there",
    "positioner__kind": "operator",
}


def by_name(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.what: finding for finding in findings}


def test_the_simulated_cell_is_well() -> None:
    findings = by_name(list(examine(CellConfig())))
    assert not [f for f in findings.values() if f.verdict is FAIL]
    assert all(f.advice for f in findings.values() if f.verdict is WARN)
    assert findings["servo 1 model_number"].verdict is PASS
    assert "serial 1" in findings["control unit"].text
    assert findings["tactile frames"].text.endswith(" 0 lost or damaged")
    assert findings["taxels at rest"].text.startswith("0 of 408")
    assert findings["noise of the taxels"].verdict is PASS
    assert findings["pads' force"].verdict is PASS
    assert "0.0 N on finger 0, 0.0 N on finger 1" in findings["pads' force"].text
    assert findings["control unit"].text.endswith("boards of the pads 1 and 2")
    assert "gripper.port" not in findings


def test_a_cell_that_was_commissioned_is_compared_with_it(tmp_path) -> None:
    store = {"steps": {"unit": {"values": {"serial_number": 7}}}, "approved": []}
    write_json(tmp_path / "commissioning.json", COMMISSIONING, store, error=CellError)
    (changed,) = [
        finding
        for finding in examine(CellConfig(), tmp_path / "tactile-cell.yaml")
        if "at commissioning" in finding.text
    ]
    assert (changed.what, changed.text) == ("control unit", "serial 1, at commissioning serial 7")
    assert f"`tactile-cell commission {tmp_path} --redo unit` repeats" in changed.advice
    (tmp_path / "commissioning.json").write_text("{")
    findings = by_name(list(examine(CellConfig(), tmp_path / "tactile-cell.yaml")))
    assert findings["commissioning"].verdict is WARN
    assert findings["servo torque"].verdict is PASS


EARLIER = Commissioning(
    {
        "unit": {"serial_number": 7, "revision": 0x10001},
        "pads_at_rest": {"board_serial_numbers": [1, 2]},
        "servos": {"servos": [{"id": n, "model": "XM430-W350", "firmware": 46} for n in (1, 2)]},
    }
)
SOUND = SourceIdentity(name="unit", serial=7, revision=0x10001, boards=(1, 2))


@pytest.mark.parametrize(
    ("changes", "what", "step"),
    [
        ({}, "", ""),
        ({"serial": 8}, "control unit", "unit"),
        ({"revision": 2}, "firmware of the unit", "unit"),
        ({"boards": (1, 9)}, "pads", "pads_at_rest"),
        ({"boards": (2, 1)}, "pads", "pads_at_rest"),
        ({1: ("XM430-W210", 46)}, "servo 1", "servos"),
    ],
)
def test_what_has_changed_names_the_step_to_repeat(changes, what, step) -> None:
    def changed(earlier: Commissioning) -> list[Finding]:
        if 1 in changes:
            return earlier.changed_servos({2: ("XM430-W350", 46)} | changes)
        return earlier.changed_unit(replace(SOUND, **changes))

    findings = changed(EARLIER)
    assert [finding.what for finding in findings] == [what] * bool(what)
    assert all(f"--redo {step}`" in finding.advice for finding in findings)
    assert changed(Commissioning()) == []


def disturb(simulated: Any) -> None:
    """Lose some frames of a running unit."""
    operational = lambda: simulated.unit.nmt_state == "OPERATIONAL"  # noqa: E731
    once(simulated.clock, operational, lambda: simulated.inject("can.lose_next=5"), after_s=0.1)


def other_model(simulated: Any) -> None:
    """Exchange servo 2 for an XM430-W210."""
    simulated.devices.servo_bus.servos[1].registers.put("model_number", 1030)


@pytest.mark.parametrize(
    ("fault", "what", "verdict", "text", "advice"),
    [
        ("unit.stuck", "noise of the taxels", WARN, "0 of 408 change at rest", "press"),
        ("unit.off", "control unit", FAIL, "did not boot", "tactile.node_id, tactile.bit"),
        ("servo2.off", "servos", FAIL, "servo 2", "gripper.servos[].id and gripper.baud_r"),
        (other_model, "servo 2 model_number", FAIL, "1030 (expected 1020)", "--redo servos"),
        (
            *("servo2.turned", "servo 2 present_position", FAIL),
            "gripper.servos[1].direction 1, zero_pulse 2048, gripper.linkage",
            "one of these keys is wrong",
        ),
        ("taxels.stuck_at=5-6:255", "taxels at rest", WARN, "2 of 408", "touching"),
        (disturb, "tactile frames", WARN, "lost or damaged", "terminating resistors"),
    ],
)
def test_a_fault_is_the_one_finding_that_does_not_pass_and_nothing_moves(
    altered, *, fault, what, verdict, text, advice
) -> None:
    cells: list[Any] = []

    def alter(simulated: Any) -> None:
        fault(simulated) if callable(fault) else simulated.inject(fault)
        cells.append((simulated, simulated.devices.mechanics.aperture_m))

    findings = altered(alter)
    finding = by_name(findings)[what]
    assert finding.verdict is verdict
    assert [one for one in findings if one.verdict is FAIL] == [finding] * (verdict is FAIL)
    assert text in finding.text
    assert advice in finding.advice
    ((simulated, before_m),) = cells
    assert simulated.devices.mechanics.aperture_m == pytest.approx(before_m, abs=1e-6)
    assert not any(servo.torque_on for servo in simulated.devices.servo_bus.servos)


@pytest.mark.parametrize(
    ("left", "verdict", "text", "advice"),
    [
        (((), ()), PASS, "servo 1 has no torque; servo 2 has no torque", ""),
        (((), (0,)), FAIL, "servo 1 has no torque (overload)", "clear --reboot"),
        (((0, 1), ()), WARN, "servo 2 has its torque on", "release --confirm"),
        (((1,), ()), FAIL, "servo 1 has no torque; servo 2 has", "release --confirm"),
        (((1,), (0,)), FAIL, "(overload); servo 2 has its torque on", "release --confirm"),
    ],
)
def test_torque_left_on_is_named_with_the_way_on(altered, left, verdict, text, advice) -> None:
    on, overloaded = left

    def alter(simulated: Any) -> None:
        for index in overloaded:
            simulated.inject(f"servo{index + 1}.overload")
        simulated.clock.sleep(0.1)
        for index in on:
            simulated.devices.servo_bus.servos[index].registers.put("torque_enable", 1)

    finding = by_name(altered(alter))["servo torque"]
    assert finding.verdict is verdict
    assert text in finding.text
    assert advice in finding.advice


@pytest.mark.parametrize(("level", "whole"), [(0, False), (1, True)])
def test_servos_that_withhold_answers_are_named_by_the_register(altered, level, whole) -> None:
    def alter(simulated: Any) -> None:
        for servo in simulated.devices.servo_bus.servos:
            servo.registers.put("status_return_level", level)

    findings = by_name(altered(alter))
    assert not [f for f in findings.values() if f.verdict is FAIL]
    assert ("servo 2 status_return_level" in findings) == whole
    named = ["servo 1 status_return_level"] if whole else ["servo torque", "servos"]
    for one in (findings[name] for name in named):
        assert one.verdict is WARN
        assert one.advice.startswith("the cell sets it at its start")
        assert whole or "Status Return Level (register 68)" in one.text


def test_boards_without_force_messages_and_numbers_are_well() -> None:
    preset = load_config(Path(__file__).parents[3] / "config" / "flexitac.yaml")
    findings = by_name(examine(preset))
    assert findings["sensor"].text == "FlexiTac"
    assert findings["force messages"].verdict is PASS
    assert findings["force messages"].text.startswith("FlexiTac sends frames alone")


@pytest.fixture
def altered(meddle: Any) -> Callable[[Callable[[Any], None]], list[Finding]]:
    """Return what examines a simulated cell after something was done to it."""

    def run(act: Callable[[Any], None]) -> list[Finding]:
        meddle(lambda made: act(made.simulated))
        return list(examine(CellConfig()))

    return run


@pytest.mark.slow
def test_the_load_of_the_pads_is_shown_and_commands_name_the_config(monkeypatch, tmp_path) -> None:
    """With no answer of the servos too: then this is all that shows a held part."""
    simulated = simulation_of(small_config())
    with contextlib.closing(build_cell(small_config(), simulated=simulated)) as held:
        held.controller.start()
        held.controller.moves.present("ball")
        held.controller.grip(6.0, Pose())
    monkeypatch.setattr(
        cell.commissioning.doctor, "build_cell", partial(build_cell, simulated=simulated)
    )
    file = tmp_path / "my cell.yaml"
    findings = by_name(list(examine(small_config(), file)))
    release = f"tactile-cell hand release --config '{file}' --confirm"
    assert release in findings["servo torque"].advice
    load = findings["pads' force"]
    assert (load.verdict, release in load.advice) == (WARN, True)
    measured_n = [float(number) for number in re.findall(r"([\d.]+) N", load.text)]
    assert measured_n == pytest.approx(simulated.world.contact_force_n(), rel=0.25)
    simulated.inject("servos.unplugged")
    findings = by_name(list(examine(small_config(), file)))
    assert "it is unknown whether a part is held" in findings["servo torque"].advice
    assert findings["pads' force"].verdict is WARN
    simulated.close()


@pytest.mark.parametrize(("n_pressed", "verdict"), [(1, PASS), (4, WARN)])
def test_a_part_at_the_contact_force_is_a_warning(n_pressed, verdict) -> None:
    """A taxel of 12 counts has about 0.1 N. The contact force is 0.6 N, most of it unseen."""
    counts = np.tile(400 + np.arange(408, dtype=np.uint16) % 5, (10, 1))
    counts[:, :n_pressed] += 12
    assert _load(counts, CellConfig(), "").verdict is verdict


def test_lines_that_cannot_be_opened_are_named() -> None:
    findings = by_name(examine(small_config(**REAL, loop__own_process=False)))
    assert findings["links"].verdict is FAIL
    assert "can-that-is-not-there" in findings["links"].text


ON_PORTS = [X_AXIS, ROTATION_AXIS, WRIST | {"port": "/dev/no-wrist"}]
AXES_CAN = {"interface": "slcan", "channel": "/dev/no-axes"}
BOARDS = {"kind": "flexitac", "ports": ("/dev/no-board", "/dev/no-other-board")}


@pytest.mark.parametrize(
    ("changes", "keys"),
    [
        (
            CHANGES | {"positioner": {"kind": "axes", "can": AXES_CAN, "axes": ON_PORTS}},
            ["tactile.channel", "positioner.can.channel", "port of the axis roll"],
        ),
        (
            {"tactile.layout": "flexitac_12x32", "tactile.sensor": BOARDS},
            ["tactile.sensor.ports[0]", "tactile.sensor.ports[1]"],
        ),
    ],
)
def test_each_wrong_port_is_named_with_what_to_do(monkeypatch, changes, keys) -> None:
    monkeypatch.setattr(cell.commissioning.doctor, "_devices", lambda *_: ())
    findings = examine(changed_config(small_config(**REAL), changes))
    missing = [finding for finding in findings if finding.verdict is FAIL]
    assert [finding.what for finding in missing] == ["gripper.port", *keys]
    assert all("No such file" in one.text and one.what in one.advice for one in missing)


AXES = changed_config(CellConfig(), CHANGES)


def test_drives_and_servos_of_axes_are_asked_and_not_moved(meddle) -> None:
    findings = by_name(list(examine(AXES)))
    assert findings["axis x (drive 11)"].text == "SWITCH ON DISABLED, position 0 increments"
    assert findings["axis roll (servo 1)"].verdict is PASS

    def spoil(made: Any) -> None:
        made.simulated.clock.sleep(0.1)
        for fault in ("axis1.fault=0x3210", "axis2.silence", "axis3.fault"):
            made.simulated.inject(fault)

    meddle(spoil)
    findings = by_name(list(examine(AXES)))
    for name, text in (
        ("axis x (drive 11)", "error 3210h: over-voltage"),
        ("axis rotation (drive 12)", "no SDO response"),
        ("axis roll (servo 1)", "hardware error overload"),
    ):
        assert findings[name].verdict is FAIL
        assert text in findings[name].text
        assert findings[name].advice
