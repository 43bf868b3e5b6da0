"""Bench of the commissioning wizard: the lines of the cell, its folder, and the config so far."""

import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from os.path import realpath
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from cell.config.file import changed_config, load_config
from cell.config.gripper import GripperConfig
from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import MODELS
from gripper.dynamixel.serial_port import ByteStream, SerialStream, serial_candidates
from tactile.can.bus import CanBus, close_bus, open_bus

_Section = TypeVar("_Section", bound=BaseModel)
CONFIG_NAME = "tactile-cell.yaml"
"""File in the cell's folder that the finished wizard writes; commands there use it by default."""
BASE_NAME = "commissioning-base.yaml"
"""File in it with the first config, until there is that one."""
_PATIENCE_S = 0.02
"""Allowance in s for adapter and operating system, enough for a latency timer of 16 ms, which is
corrected later."""


class LineOpener:
    """Opens the lines of a cell: here the ports of this machine."""

    clock: Clock = time

    def serial_ports(self) -> tuple[str, ...]:
        """Return the paths of the serial ports that are plugged in.

        Ports of the main board (ttyS) are omitted: most of them have no device.
        """
        return tuple(p for p in serial_candidates() if not Path(p).name.startswith("ttyS"))

    def open_serial(self, port: str, baud_rate: int) -> ByteStream:
        """Open a serial port. Raises gripper.errors.PortLost."""
        return SerialStream(port, baud_rate)

    def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
        """Open a CAN bus. Raises tactile.errors.BusNotOpened."""
        return open_bus(interface, channel, bitrate=bitrate)


class Bench:
    """Lines, folder and config for the steps. Each step opens the lines it needs, and closes them.

    Raises ConfigError if the config of the folder is not valid.

    Parameters
    ----------
    folder
        Folder of the cell: commissioning.json, config, record, backups.
    lines
        Opens ports and buses.
    given
        Values of the config by dotted key that the person gave at the start, e.g.
        ``{"gripper.port": "/dev/ttyUSB0"}``; steps use them instead of asking.
    base
        First config, whose values stay unless a step finds others; by default that of the folder,
        if there is one.
    """

    def __init__(
        self,
        folder: Path,
        lines: LineOpener | None = None,
        *,
        given: Mapping[str, Any] | None = None,
        base: CellConfig | None = None,
    ) -> None:
        self.folder = folder
        for path in (folder / CONFIG_NAME, folder / BASE_NAME):
            if base is None and path.exists():
                base = load_config(path)
        self.base = base or CellConfig(name=folder.resolve().name[:80] or "cell")
        """First config."""
        self.lines = lines or LineOpener()
        self.given: Mapping[str, Any] = given or {}
        self.settings: Mapping[str, Any] = {}
        """Values of the config by dotted key that the steps have found so far, also the running
        one."""
        self.values: Mapping[str, Mapping[str, Any]] = {}
        """Values of the findings so far, by the key of the step."""

    @property
    def clock(self) -> Clock:
        """Time of the lines."""
        return self.lines.clock

    @property
    def config(self) -> CellConfig:
        """The whole config so far. Raises ConfigError while it is incomplete."""
        changes: dict[str, Any] = {}
        positioner = self.base.positioner
        if positioner.kind == "simulated" and not positioner.socket:
            changes["positioner"] = {"kind": "operator"}
        return changed_config(self.base, changes | self._changes())

    def gripper(self, **changes: Any) -> GripperConfig:
        """Return the gripper's section so far, with some keys changed; raises ConfigError."""
        return self._section("gripper", self.base.gripper, changes)

    def tactile(self, **changes: Any) -> TactileConfig:
        """Return the control unit's section so far, with some keys changed; raises ConfigError."""
        return self._section("tactile", self.base.tactile, changes)

    def _section(self, name: str, base: _Section, changes: Mapping[str, Any]) -> _Section:
        values = {
            k.partition(".")[2]: v for k, v in self._changes().items() if k.startswith(f"{name}.")
        }
        return changed_config(base, values | dict(changes))

    def _changes(self) -> dict[str, Any]:
        """Return the settings, with what no step measures as in the base.

        That is ``measured`` of each servo, and an opening below the widest one that was found.
        """
        settings = dict(self.settings)
        if settings.get("gripper.aperture_open_mm", 0.0) > self.base.gripper.aperture_open_mm:
            del settings["gripper.aperture_open_mm"]
        measured = {(servo.id, servo.model): servo.measured for servo in self.base.gripper.servos}
        servos = [
            servo | {"measured": measured.get((servo["id"], servo["model"]), "")}
            for servo in settings.get("gripper.servos", ())
        ]
        return settings | ({"gripper.servos": servos} if servos else {})

    def ports_beside(self, used: str) -> list[str]:
        """Return the serial ports without the one in use."""
        return [port for port in self.lines.serial_ports() if realpath(port) != realpath(used)]

    def servo_bus(self, port: str | None = None, baud_rate: int | None = None) -> closing[ServoBus]:
        """Open the line of the servos, and close it at the end of the block; goals and torque stay.

        Port and baud rate are by default those of the config so far.
        """
        gripper = self.gripper()
        rate = baud_rate or gripper.baud_rate
        bus = ServoBus(
            self.lines.open_serial(port or gripper.port, rate),
            baudrate=rate,
            clock=self.clock,
            allowance_s=_PATIENCE_S,
            ram_shifts={servo.id: MODELS[servo.model].ram_shift for servo in gripper.servos},
        )
        return closing(bus)

    @contextmanager
    def can_bus(self, interface: str, channel: str, bitrate: int) -> Iterator[CanBus]:
        """Open a CAN bus, and close it at the end."""
        bus = self.lines.open_can(interface, channel, bitrate)
        try:
            yield bus
        finally:
            close_bus(bus)
