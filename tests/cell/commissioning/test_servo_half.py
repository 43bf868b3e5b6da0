"""The servos' half of the wizard, on simulated servos that are new, wrong or badly mounted."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning import backup
from cell.commissioning.backup import restore
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Engine, Finding, Left, Verdict
from cell.commissioning.fingers import FingersStep
from cell.commissioning.ports import PortsStep
from cell.commissioning.servos import ServosStep
from cell.errors import CellError
from gripper.dynamixel.control_table import TORQUE_ENABLE
from gripper.servos.group import ServoGroup
from simulator.cell import SimulatedCell
from simulator.servo.mechanics import RackLinkage, ServoMount
from simulator.settings import SimulatedServoSettings, SimulatorSettings
from tests.cell.commissioning.hands import Hands
from tests.cell.commissioning.script import Reply, Script, SimulatedLines

STEPS = (PortsStep(), ServosStep(), FingersStep())


class Walk:
    """The servos' half on one simulated cell."""

    def __init__(
        self,
        folder: Path,
        *faults: str,
        first: int = 1,
        settings: SimulatorSettings | None = None,
    ) -> None:
        self.cell = SimulatedCell(settings or SimulatorSettings(faults=faults))
        self.cell.clock.sleep(1.0)
        self.hands = Hands(self.cell, first=first)
        self.folder = folder
        self.script = Script()

    def bench(self) -> Bench:
        return Bench(self.folder, SimulatedLines(self.cell))

    def run(
        self,
        *,
        leave_at: tuple[str, ...] = (),
        steps: tuple[PortsStep | ServosStep | FingersStep, ...] = STEPS,
        moment: Callable[[], None] = lambda: None,
        **replies: Reply | list[Reply],
    ) -> dict[str, Finding]:
        """Run the steps once; the first that fails is left. Returns the findings."""
        named = {key.replace("__", "."): reply for key, reply in replies.items()}
        again = {f"{step.key}.again": "leave" for step in steps}
        replies_now = self.hands.replies() | again | named
        self.script = Script(replies_now, leave_at=list(leave_at), moment=moment)
        engine = Engine(steps, self.bench())
        for number, step in enumerate(steps, start=1):
            if engine.done(step):
                continue
            self.script.begin(step, number, len(steps))
            engine._run(step, self.script)
            if not engine.done(step):
                break
        return dict(engine.findings)

    def torques(self) -> list[int]:
        return [
            s.core.registers.get(TORQUE_ENABLE.name) for s in self.cell.devices.servo_bus.servos
        ]

    def registers(self, name: str) -> list[int]:
        return [s.core.registers.get(name) for s in self.cell.devices.servo_bus.servos]


def test_factory_new_servos_are_numbered_one_at_a_time(tmp_path: Path) -> None:
    walk = Walk(tmp_path, "servo1.factory", "servo2.factory")
    found = walk.run(steps=STEPS[:2])["servos"]
    assert found.status is Verdict.PASS, found.lines
    assert walk.script.asked == ["servos.connect_one", "servos.connect_next"]
    assert (walk.registers("id"), walk.registers("baud_rate")) == ([1, 2], [3, 3])
    assert walk.registers("operating_mode") == [5, 5]
    assert walk.registers("return_delay_time") == [0, 0]
    shown = {(w.what, w.before, w.after) for w in walk.script.writes}
    assert ("id (7)", "1", "2") in shown
    assert ("baud_rate (8)", "57600 bit/s", "1000000 bit/s") in shown
    for number in (1, 2):
        kept = json.loads((tmp_path / f"backup-servo{number}.json").read_text())
        assert (kept["found"]["id"], kept["found"]["baud_rate"]) == (1, 1)
        assert kept["found"]["return_delay_time"] == 250


def test_restore_brings_the_servos_back_as_they_came(tmp_path: Path) -> None:
    walk = Walk(tmp_path, "servo1.factory", "servo2.factory")
    before = [bytes(s.core.table.data[:64]) for s in walk.cell.devices.servo_bus.servos]
    walk.run(steps=STEPS[:2])
    lines = restore(walk.bench(), script := Script(), "/dev/ttyUSB0")
    assert [bytes(s.core.table.data[:64]) for s in walk.cell.devices.servo_bus.servos] == before
    assert len(lines) == 2
    assert ("id (7)", "2", "1") in {(w.what, w.before, w.after) for w in script.writes}
    # Restored servos are left alone, and are brought up again from there.
    again = restore(walk.bench(), Script(), "/dev/ttyUSB0")
    assert again == ("all servos are as they were found",)
    Engine(STEPS, walk.bench()).redo("servos")
    assert walk.run(steps=STEPS[:2])["servos"].status is Verdict.PASS
    with pytest.raises(CellError, match="no backup"):
        restore(Bench(tmp_path / "other", SimulatedLines(walk.cell)), Script(), "/dev/ttyUSB0")


def test_a_restore_that_was_interrupted_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = Walk(tmp_path, "servo1.factory", "servo2.factory")
    before = [bytes(s.core.table.data[:64]) for s in walk.cell.devices.servo_bus.servos]
    walk.run(steps=STEPS[:2])
    write_back = backup._write_back

    def first_only(*arguments: Any) -> None:
        write_back(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(backup, "_write_back", first_only)
        with pytest.raises(KeyboardInterrupt):
            restore(walk.bench(), Script(), "/dev/ttyUSB0")
    assert len(restore(walk.bench(), Script(), "/dev/ttyUSB0")) == 1
    assert [bytes(s.core.table.data[:64]) for s in walk.cell.devices.servo_bus.servos] == before


def test_one_servo_with_a_pinion(tmp_path: Path) -> None:
    one = SimulatorSettings(
        servos=(SimulatedServoSettings(servo_id=1, mount=ServoMount(direction=-1)),),
        linkage=RackLinkage(pinion_radius_m=0.02),
    )
    walk = Walk(tmp_path, settings=one)
    found = walk.run(servos__count="1")["fingers"]
    assert found.status is Verdict.PASS, found.lines
    assert "fingers.open_second" not in walk.script.asked
    assert found.settings["gripper.servos"][0]["direction"] == -1
    linkage = found.settings["gripper.linkage"]
    assert linkage["kind"] == "rack_pinion"
    assert linkage["pinion_radius_mm"] == pytest.approx(20.0, rel=0.02)


def test_nothing_is_written_that_was_refused(tmp_path: Path) -> None:
    walk = Walk(tmp_path, "servo1.factory", "servo2.factory")
    before = [bytes(s.core.table.data[:64]) for s in walk.cell.devices.servo_bus.servos]
    with pytest.raises(Left):
        walk.run(steps=STEPS[:2], leave_at=("approve",))
    assert [bytes(s.core.table.data[:64]) for s in walk.cell.devices.servo_bus.servos] == before
    assert not list(tmp_path.glob("backup*"))


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("servo2.supply=6", "servo 2 has 6.0 V, a XM430-W350 takes 9.5 to 16.0 V"),
        ("servo2.wrong=model_number:1060", "servo 2 is XL430-W250"),
        ("servo2.wrong=model_number:1200", "need different supplies"),
        ("servo2.error=8", "servo 2 reports"),
        ("servos.delayed=0.016", "latency timer"),
        ("servos.off", "no servo answers at any baud rate: check the supply"),
    ],
)
def test_wrong_servos_are_named(tmp_path: Path, fault: str, said: str) -> None:
    walk = Walk(tmp_path, fault)
    found = walk.run(steps=STEPS[:2])["servos"]
    assert found.status is Verdict.FAIL
    assert said in "\n".join(found.lines)
    assert walk.torques() == [0, 0]


def test_wrong_registers_are_shown_then_set_and_read_back(tmp_path: Path) -> None:
    wrong = ("servo1.wrong=homing_offset:100", "servo2.wrong=drive_mode:1")
    walk = Walk(tmp_path, *wrong)
    found = walk.run(steps=STEPS[:2])["servos"]
    assert found.status is Verdict.PASS, found.lines
    shown = {(w.where, w.what, w.before, w.after) for w in walk.script.writes}
    assert ("servo 1", "homing_offset (20)", "100", "0") in shown
    assert ("servo 2", "drive_mode (10)", "1", "0") in shown
    assert walk.registers("homing_offset") == [0, 0]
    assert walk.registers("drive_mode") == [0, 0]


def test_directions_zero_and_linkage_of_badly_mounted_servos(tmp_path: Path) -> None:
    walk = Walk(tmp_path, "servo2.turned", "servo1.horn=164", first=2)
    found = walk.run()["fingers"]
    assert found.status is Verdict.PASS, found.lines
    first, second = found.settings["gripper.servos"]
    assert (first["id"], first["direction"]) == (2, -1)
    assert (second["id"], second["direction"]) == (1, 1)
    assert second["zero_pulse"] == pytest.approx(2048 + 164, abs=2)
    assert first["zero_pulse"] == pytest.approx(2048, abs=2)
    linkage = found.settings["gripper.linkage"]
    assert linkage["kind"] == "parallel_linkage"
    assert linkage["link_mm"] == pytest.approx(60.0, rel=0.02)
    assert found.values["residual_mm"] < 0.3
    assert "servo 1: its zero is +16" in "\n".join(found.lines)
    assert "opened by" in "\n".join(found.lines)
    assert walk.torques() == [0, 0]
    assert walk.script.watched


def test_a_motion_that_a_person_does_not_see_as_opening_is_no_success(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    found = walk.run(fingers__opened="no")["fingers"]
    assert found.status is Verdict.FAIL
    assert found.settings == {}
    assert walk.torques() == [0, 0]


def test_a_person_stops_the_first_motion_while_it_runs(tmp_path: Path) -> None:
    walk = Walk(tmp_path)

    def stop() -> None:
        if walk.torques() == [1, 1]:
            raise Left("stopped at the page")

    with pytest.raises(Left, match="at the page"):
        walk.run(moment=stop)
    assert walk.torques() == [0, 0]


def test_a_finger_that_cannot_move_is_named_and_limp(tmp_path: Path) -> None:
    walk = Walk(tmp_path)

    def pinched() -> None:
        walk.hands.free()
        walk.cell.devices.mechanics.motors[1].friction_nm = 5.0

    found = walk.run(fingers__free=pinched)["fingers"]
    assert found.status is Verdict.FAIL
    assert "finger 1 (servo 2): did not move" in "\n".join(found.lines)
    assert walk.torques() == [0, 0]


def test_a_finger_that_was_not_moved_is_asked_for_again(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    opened = [lambda: None, lambda: walk.hands.move(servo1=0.05)]
    walk.run(fingers__open_first=[*opened])
    assert walk.script.asked.count("fingers.open_first") == 2
    assert "One finger should have moved" in walk.script.text


def test_fingers_that_were_not_closed_are_found_out(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    found = walk.run(fingers__close=walk.hands.close_on(20.0))["fingers"]
    assert found.status is Verdict.FAIL
    assert "something was between them" in found.lines[0]
    assert "fingers.block2" not in walk.script.asked


def test_a_thickness_that_was_typed_wrong_is_found_by_a_third_block(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    replies: dict[str, Reply] = {
        "fingers__block2": 50.0,
        "fingers__on_block2": walk.hands.close_on(30.0),
        "fingers__on_block3": walk.hands.close_on(20.0),
    }
    found = walk.run(fingers__block3=20.0, **replies)["fingers"]
    assert found.status is Verdict.FAIL
    assert "was a thickness typed wrong" in found.lines[0]
    assert "fingers.free" not in walk.script.asked
    # A smaller error, and no third block: the residual warns.
    replies["fingers__block2"] = 33.0
    found = walk.run(fingers__block3=0.0, **replies)["fingers"]
    assert found.status is Verdict.WARN
    assert "the residual is above 0.5 mm: measure the blocks again" in "\n".join(found.lines)


def test_one_block_is_enough_and_worth_a_word(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    found = walk.run(fingers__block2=0.0)["fingers"]
    assert found.status is Verdict.WARN
    assert found.settings["gripper.linkage"]["link_mm"] == pytest.approx(60.0, rel=0.05)


def test_a_finger_that_goes_the_wrong_way_goes_limp(tmp_path: Path) -> None:
    walk = Walk(tmp_path)

    def drifting() -> None:
        walk.hands.free()
        walk.cell.inject("servo1.drift=-0.2")

    found = walk.run(fingers__free=drifting)["fingers"]
    assert found.status is Verdict.FAIL
    assert "finger 0 (servo 1): closed instead of opening" in found.lines[-1]
    assert walk.torques() == [0, 0]


def test_leaving_at_each_question_leaves_no_torque(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    walk.run()
    for place in [key for key in walk.script.asked if key.startswith("fingers")] + ["approve"]:
        other = Walk(tmp_path / place)
        with pytest.raises(Left):
            other.run(leave_at=(place,))
        assert other.torques() == [0, 0]


def test_torque_that_holds_a_part_is_not_switched_off_unasked(tmp_path: Path) -> None:
    walk = Walk(tmp_path, "servo1.wrong=homing_offset:100")
    for servo in walk.cell.devices.servo_bus.servos:
        servo.core.set_torque(on=True)
    with pytest.raises(Left, match="torque"):
        walk.run()
    assert walk.torques() == [1, 1]
    walk.run(servos__torque="off", steps=STEPS[:2])
    assert walk.torques() == [0, 0]


def test_an_interruption_of_the_first_motion_leaves_the_fingers_limp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = Walk(tmp_path)
    write, seen = ServoGroup.write_goals, []

    def interrupted(group: ServoGroup, goals: Any, state: Any, **options: Any) -> None:
        seen.append(walk.torques())
        if len(seen) > 20:
            raise KeyboardInterrupt
        write(group, goals, state, **options)

    monkeypatch.setattr(ServoGroup, "write_goals", interrupted)
    with pytest.raises(KeyboardInterrupt):
        walk.run()
    assert seen[-1] == [1, 1]
    assert walk.torques() == [0, 0]
