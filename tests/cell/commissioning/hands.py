"""A person at the simulated cell in virtual time: hands at fingers, blocks and plugs, answers."""

import re
from collections.abc import Callable
from typing import Any

from cell.commissioning.law import GRAVITY_N_KG
from simulator.cell import SimulatedCell
from simulator.world.shapes import ObjectPose
from tests.cell.commissioning.script import Reply, Script

WIDE_M = 0.05
"""Half opening in m to which a person opens a finger."""


class Hands:
    """Does what the wizard asks a person for, at a simulated cell.

    Parameters
    ----------
    cell
        The cell.
    blocks_mm
        Thicknesses of the blocks, in mm.
    first
        Number of the servo whose finger is opened first: finger 0.
    """

    def __init__(
        self, cell: SimulatedCell, blocks_mm: tuple[float, ...] = (10.0, 30.0), first: int = 1
    ) -> None:
        self.cell = cell
        self.blocks_mm = blocks_mm
        self.servos = len(cell.settings.servos)
        self.first = first

    def move(self, **half_openings_m: float) -> None:
        """Move fingers, as ``servo1=0.02``, and wait until they are left."""
        mechanics = self.cell.devices.mechanics
        for name, half_opening_m in half_openings_m.items():
            mechanics.move_by_hand(int(name.removeprefix("servo")) - 1, half_opening_m)
        while mechanics.moved_by_hand:
            self.cell.clock.sleep(0.01)

    def all_to(self, half_opening_m: float) -> None:
        self.move(**{f"servo{i}": half_opening_m for i in range(1, self.servos + 1)})

    def close_on(self, block_mm: float) -> Callable[[], None]:
        def act() -> None:
            self.all_to(WIDE_M)
            shape = f"box:length=20mm,width=12mm,height={block_mm}mm"
            self.cell.place(shape, ObjectPose())
            self.all_to(0.0)

        return act

    def close(self) -> None:
        self.cell.remove()
        self.all_to(0.0)

    def free(self) -> None:
        self.cell.remove()
        self.all_to(0.02)

    def only(self, number: int) -> Callable[[], None]:
        """Connect one servo alone."""

        def act() -> None:
            for other in range(1, self.servos + 1):
                self.disconnect(other, off=other != number)

        return act

    def disconnect(self, number: int, *, off: bool) -> None:
        silent = self.cell.devices.faults.servo_wire.silent
        servo_id = self.cell.settings.servos[number - 1].servo_id
        (silent.add if off else silent.discard)(servo_id)

    def connect_all(self) -> None:
        for number in range(1, self.servos + 1):
            self.disconnect(number, off=False)

    def replies(self) -> dict[str, Reply | list[Reply]]:
        """Return the answers of a person who does all that is asked for."""
        second = 3 - self.first
        return {
            "servos.connect_one": self.only(self.first),
            "servos.connect_next": self.connect_all,
            "fingers.close": self.close,
            "fingers.open_first": lambda: self.move(**{f"servo{self.first}": WIDE_M}),
            "fingers.open_second": lambda: self.move(**{f"servo{second}": WIDE_M}),
            "fingers.block1": self.blocks_mm[0],
            "fingers.block2": self.blocks_mm[1] if len(self.blocks_mm) > 1 else 0.0,
            "fingers.on_block1": self.close_on(self.blocks_mm[0]),
            "fingers.on_block2": self.close_on(self.blocks_mm[-1]),
            "fingers.free": self.free,
            "fingers.opened": "yes",
        }


class Person:
    """Answers and hands of a person who does all that the wizard asks for.

    Parameters
    ----------
    cell
        The cell.
    presses
        Returns the pad that a fingertip presses for the one that is asked for, None for no press.
    replies
        Other answers, by the keys of the questions, ``__`` for the point.

    Attributes
    ----------
    script
        The dialog, with what was asked and shown.
    pressed_n
        Largest force on the soft part in N.
    """

    def __init__(
        self,
        cell: SimulatedCell,
        *,
        presses: Callable[[int], int | None] = lambda pad: pad,
        **replies: Any,
    ) -> None:
        self._cell = cell
        self._layout = cell.settings.layout
        self.pressed_n = 0.0
        self._presses = presses
        told: dict[str, Any] = {
            f"pads_law.{finger}.{number}": self._load(finger, force_n)
            for finger in (0, 1)
            for number, force_n in enumerate((2.0, 5.0, 8.0), start=1)
        }
        told |= {
            "pads_law.with": self._nothing,
            "first_force.most": 4.0,
            "first_force.empty": self._nothing,
            "first_force.part": lambda: cell.place("ball") and None,
            "first_force.empty_again": self._nothing,
            "baseline.empty": self._nothing,
            "baseline.place": lambda: cell.place("ball") and None,
        }
        told |= Hands(cell).replies()
        told |= {key.replace("__", "."): reply for key, reply in replies.items()}
        self.script = Script(told, moment=self.moment)

    def _load(self, finger: int, force_n: float) -> Callable[[], float]:
        # Whose finger it is, whatever the control unit calls it.
        def reply() -> float:
            pad = self._layout.gripping_pads[finger]
            self._cell.devices.physical.press(pad, 0.0, 0.0, force_n)
            return force_n / GRAVITY_N_KG * 1e3

        return reply

    def _nothing(self) -> None:
        self._cell.remove()
        self._cell.devices.physical.lift()

    def moment(self) -> None:
        """Press the pad near the corner that was asked for last, or lift the fingertip."""
        asked = self.script.asked
        if "first_force.part" in asked and "first_force.empty_again" not in asked:
            self.pressed_n = max(self.pressed_n, *self._cell.world.contact_force_n())
        last = next((t for t in reversed(self.script.said) if "fingertip" in t), "")
        press = re.match(r"Press (\S+) with", last)
        names = [pad.name for pad in self._layout.pads]
        pad = self._presses(names.index(press[1])) if press else None
        world = self._cell.devices.physical
        if pad is None:
            world.lift()
            return
        one = self._layout.pads[pad]
        x_m, y_m = 0.4 * one.rows * one.pitch_x_m, 0.3 * one.columns * one.pitch_y_m
        world.press(pad, x_m, y_m, 2.0)
