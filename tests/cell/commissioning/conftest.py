"""Steps of the wizard on simulated cells, in virtual time."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Step, carry_out
from cell.commissioning.findings import Notes, Verdict
from gripper.dynamixel.control_table import TORQUE_ENABLE
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.layout import pinch_layout
from tests.cell.commissioning.hands import Person, SimulatedLines

KNOWN = {
    "gripper.port": "/dev/ttyUSB0",
    "gripper.servos": [
        {"id": 1, "model": "XM430-W350", "direction": 1, "zero_pulse": 2048},
        {"id": 2, "model": "XM430-W350", "direction": 1, "zero_pulse": 2048},
    ],
    "gripper.aperture_open_mm": 14.0,
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "tactile.layout": "pinch",
    "tactile.tare_frames": 30,
    "sequence.ramp.rate_n_s": 10.0,
    "sequence.ramp.hold_s": 0.0,
}
"""What the steps have found of a sound cell."""


class Stand:
    """One simulated cell whose steps have found what it is, its bench, and a person who helps."""

    def __init__(self, cell: SimulatedCell, folder: Path) -> None:
        self.cell = cell
        self.lines = SimulatedLines(cell)
        self.bench = Bench(folder, self.lines)
        self.bench.settings = dict(KNOWN)
        self.person = Person(cell)

    def run(
        self,
        step: Step,
        *,
        leave_at: Sequence[str] = (),
        moment: Callable[[], None] | None = None,
        **replies: Any,
    ) -> Notes:
        """Carry a step out with a person anew, who answers as named, ``__`` for the point."""
        self.person = Person(self.cell, **replies)
        self.person.script.leave_at = list(leave_at)
        self.person.script.moment = moment or self.person.script.moment
        return carry_out(step, self.bench, self.person.script)

    def ends(self, verdict: Verdict, step: Step, *named: str, **options: Any) -> Notes:
        """Carry a step out as `run`; fail where it ends otherwise or its lines lack a text."""
        finding = self.run(step, **options)
        text = "\n".join(finding.lines)
        assert (finding.status, [one for one in named if one not in text]) == (verdict, []), text
        return finding

    def passes(self, step: Step, *named: str, **options: Any) -> Notes:
        return self.ends(Verdict.PASS, step, *named, **options)

    def knows(self, **settings: Any) -> None:
        """Let the steps have found other values, ``__`` for the point."""
        named = {key.replace("__", "."): value for key, value in settings.items()}
        self.bench.settings = {**self.bench.settings, **named}

    @property
    def torques(self) -> list[int]:
        """Torque Enable of each servo."""
        return self.registers(TORQUE_ENABLE.name)

    def registers(self, name: str) -> list[int]:
        """Return the raw value of an item of each servo."""
        return [s.registers.get(name) for s in self.cell.devices.servo_bus.servos]


MakeStand = Callable[..., Stand]
"""Maker of stands of a cell with some faults and settings."""


@pytest.fixture
def make_stand(tmp_path: Path, undo: ExitStack) -> MakeStand:
    """Return what makes a stand of a cell with some faults and settings; closed at the end."""

    def make(*faults: str, **settings: Any) -> Stand:
        named = {"layout": pinch_layout(), "aperture_m": 0.014} | settings
        made = SimulatorSettings(**named, faults=faults)
        return Stand(undo.enter_context(SimulatedCell(made)), tmp_path)

    return make


@pytest.fixture
def stand(make_stand: MakeStand) -> Stand:
    return make_stand()
