"""Hands of a person at the simulated cell in virtual time: fingers, blocks, plugs."""

from collections.abc import Callable

from simulator.cell import SimulatedCell
from simulator.world.shapes import ObjectPose
from tests.cell.commissioning.script import Reply

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
