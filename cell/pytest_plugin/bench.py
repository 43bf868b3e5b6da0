"""Both links of a cell without its controller: simulated, or real where a port is named."""

import time
from contextlib import ExitStack
from dataclasses import dataclass

from cell.config.model import CellConfig
from cell.pytest_plugin.configs import simulated_config
from cell.pytest_plugin.faults import FaultRegistry
from cell.pytest_plugin.options import HardwareOptions
from cell.simulation import simulator_settings
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.serial_port import ByteStream, open_line
from gripper.state import Clock
from simulator.cell import SimulatedCell
from tactile.can.bus import CanBus, close_bus, open_bus


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoEnd:
    """The host's end of the servo line."""

    stream: ByteStream
    """Its bytes."""
    bus: ServoBus
    """Its transactions."""
    clock: Clock
    """The time that passes for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CanEnd:
    """The host's end of the CAN bus, and the time that passes for it."""

    bus: CanBus
    clock: Clock


class LinkBench:
    """Opens the two links when they are asked for, each once; simulated ones share their devices.

    Parameters
    ----------
    config
        The cell: rates, servo IDs, node.
    options
        Names the real ports.
    registry
        Is told what is simulated and what is real.
    """

    def __init__(
        self, config: CellConfig, options: HardwareOptions, registry: FaultRegistry
    ) -> None:
        self.config = config
        self.options = options
        self._registry = registry
        self._simulated: SimulatedCell | None = None
        self._servos: ServoEnd | None = None
        self._can: CanEnd | None = None
        self._closing = ExitStack()

    @property
    def simulated(self) -> SimulatedCell:
        """The simulated devices, made when first asked for."""
        if self._simulated is None:
            settings = simulator_settings(simulated_config(self.config))
            self._simulated = SimulatedCell(settings)
            self._closing.callback(self._simulated.close)
            self._registry.add(self._simulated)
        return self._simulated

    def servos(self) -> ServoEnd:
        """Open the servo line; no servo is written to. Raises gripper.errors.PortLost."""
        if self._servos is None:
            port, rate = self.options.servo_port, self.config.gripper.baud_rate
            if port is not None:
                self._registry.add_hardware(f"servos at {port}")
            stream, clock = open_line(self.simulated.servo_port if port is None else port, rate)
            bus = ServoBus(
                stream,
                baudrate=rate,
                clock=clock,
                period_s=1.0 / self.config.gripper.loop_rate_hz,
            )
            self._closing.callback(bus.close)
            self._servos = ServoEnd(stream=stream, bus=bus, clock=clock)
        return self._servos

    def can(self) -> CanEnd:
        """Open the CAN bus; nothing is sent. Raises tactile.errors.BusNotOpened."""
        if self._can is None:
            interface, channel = self.options.can_interface, self.options.can_channel
            if interface is None or channel is None:
                self._can = CanEnd(bus=self.simulated.can_bus, clock=self.simulated.clock)
            else:
                self._registry.add_hardware(f"control unit at {interface} {channel}")
                bus = open_bus(interface, channel, bitrate=self.config.tactile.bitrate)
                self._closing.callback(close_bus, bus)
                self._can = CanEnd(bus=bus, clock=time)
        return self._can

    def close(self) -> None:
        """Close what was opened; the servos keep doing what they were told last."""
        self._closing.close()
