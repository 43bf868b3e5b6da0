"""Both links of a cell without its controller: simulated, or real if a port is named."""

import time
from dataclasses import dataclass
from functools import cached_property

from cell.config.model import CellConfig
from cell.simulation import simulator_settings
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.serial_port import ByteStream, open_line
from pytest_tactile_cell.configs import simulated_config
from pytest_tactile_cell.faults import FaultRegistry
from pytest_tactile_cell.options import HardwareOptions
from simulator.cell import SimulatedCell
from tactile.can.bus import CanBus, close_bus, open_bus


@dataclass
class LinkBench:
    """Opens the two links on demand, each once; simulated links share their devices."""

    config: CellConfig
    """The cell: rates, servo IDs, node."""
    options: HardwareOptions
    """Names the real ports."""
    registry: FaultRegistry
    """Registers simulated devices and real hardware, and closes the links."""

    @cached_property
    def simulated(self) -> SimulatedCell:
        """The simulated devices, created at the first use."""
        simulated = SimulatedCell(simulator_settings(simulated_config(self.config)))
        self.registry.add(simulated, simulated.close)
        return simulated

    @cached_property
    def servo_line(self) -> tuple[ByteStream, Clock]:
        """Bytes of the servo line, and its clock; raises PortLost."""
        port, rate = self.options.servo_port, self.config.gripper.baud_rate
        if port is not None:
            self.registry.add_hardware(f"servos at {port}")
        stream, clock = open_line(self.simulated.servo_port if port is None else port, rate)
        self.registry.callback(stream.close)
        return stream, clock

    @cached_property
    def servo_bus(self) -> ServoBus:
        """Transactions on the servo line; nothing is written to a servo. Raises PortLost."""
        stream, clock = self.servo_line
        gripper = self.config.gripper
        return ServoBus(
            stream, baudrate=gripper.baud_rate, clock=clock, period_s=1.0 / gripper.loop_rate_hz
        )

    @cached_property
    def can_line(self) -> tuple[CanBus, Clock]:
        """The CAN bus, without sending, and its clock; raises BusNotOpened."""
        interface, channel = self.options.can_interface, self.options.can_channel
        if interface is None or channel is None:
            return self.simulated.can_bus, self.simulated.clock
        self.registry.add_hardware(f"control unit at {interface} {channel}")
        bus = open_bus(interface, channel, bitrate=self.config.tactile.bitrate)
        self.registry.callback(close_bus, bus)
        return bus, time
