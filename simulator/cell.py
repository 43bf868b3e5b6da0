"""The simulated cell: one world, its devices, and the host's ends of their buses in memory."""

from typing import Self

from simulator.can.link import InMemoryCanBus
from simulator.clock import VirtualClock
from simulator.devices import CellDevices
from simulator.errors import PortUnplugged, SimulatorStateError
from simulator.faults.injector import FaultInjector
from simulator.faults.vocabulary import Fault
from simulator.servo.bus import MemoryServoStream
from simulator.servo.wrist import SimulatedWrist
from simulator.settings import SimulatorSettings
from simulator.world.shapes import ObjectPose
from tactile.layout import TaxelLayout, paper_layout


class SimulatedCell:
    """The simulated cell in virtual time: in one thread, as fast as possible.

    Parameters
    ----------
    clock
        Its clock; inject the same clock into all clients of the cell.
    """

    def __init__(
        self, settings: SimulatorSettings | None = None, clock: VirtualClock | None = None
    ) -> None:
        self.settings = settings or SimulatorSettings()
        self.clock = clock or VirtualClock()
        self.devices = CellDevices(self.settings, start_s=self.clock.monotonic())
        self.world = self.devices.world
        """The world between the fingers."""
        self.unit = self.devices.unit
        """The control unit."""
        self.injector = FaultInjector(self.devices, self.clock.monotonic())
        self.clock.on_advance += [self.devices.advance_to, self.injector.advance]
        self._servo_port = MemoryServoStream(self.devices.servo_bus, self.clock)
        self._closed = False
        self.can_bus = InMemoryCanBus(self.devices.can, self.clock)
        """The host's end of the CAN bus; its ``clock`` is that of the cell."""
        self.axes_can_bus: InMemoryCanBus | None = None
        """The host's end of the bus of the axes' drives; None without drives."""
        if self.devices.axes_can is not None:
            self.axes_can_bus = InMemoryCanBus(self.devices.axes_can, self.clock)
        self.axes_streams = {
            moves: MemoryServoStream(axis.bus, self.clock)
            for moves, axis in self.devices.axes.items()
            if isinstance(axis, SimulatedWrist)
        }
        """The host's ends of the lines of the axes' servos, by their part of the pose."""
        self.board_streams = [MemoryServoStream(b, self.clock) for b in self.devices.boards]
        """The host's ends of the lines of the sensor boards, by finger."""
        for text in self.settings.faults:
            self.inject(text)

    @property
    def servo_port(self) -> MemoryServoStream:
        """The host's end of the servo bus; reopened after it was closed."""
        if self._servo_port.closed and not self._closed:
            self._servo_port = MemoryServoStream(self.devices.servo_bus, self.clock)
        return self._servo_port

    def inject(self, text: str) -> Fault:
        """Inject a fault by its text, for example ``can.loss=0.05@contact+0.5s``.

        Its times count from now. `simulator.faults.vocabulary.VOCABULARY` has all faults.

        Raises
        ------
        SimulatorSettingsError
            If the fault is unknown, or its value does not fit this cell.
        SimulatorStateError
            If another fault uses the same knob at that time.
        """
        return self.injector.inject(text)

    def place(self, label: str, pose: ObjectPose | None = None) -> ObjectPose:
        """Put an object between the open pads; see `CellDevices.place`."""
        return self.devices.place(label, pose)

    def remove(self) -> None:
        """Take the object away."""
        self.devices.world.remove()

    def open_servo_port(self) -> MemoryServoStream:
        """Reopen the host's end of the servo line, as after its adapter was unplugged.

        Raises PortUnplugged while the adapter is unplugged.
        """
        if self.devices.faults.servo_wire.unplugged:
            raise PortUnplugged("the adapter of the simulated servos is unplugged: plug it in")
        self._servo_port.close()
        return self.servo_port

    def open_board(self, finger: int) -> MemoryServoStream:
        """Reopen the line of a finger's board. Raises PortUnplugged while it is unplugged."""
        board = self.devices.boards[finger]
        if board.unplugged:
            raise PortUnplugged(f"the simulated board of finger {finger} is unplugged: plug it in")
        self.board_streams[finger].close()
        board.drop_pending()
        self.board_streams[finger] = MemoryServoStream(board, self.clock)
        return self.board_streams[finger]

    def open_can_bus(self, bitrate: int | None = None) -> InMemoryCanBus:
        """Reopen the host's end of the CAN bus, as after its adapter was unplugged.

        With another ``bitrate`` in bit/s than that of the bus the adapter receives nothing.

        Raises SimulatorStateError while the adapter is unplugged.
        """
        if self.devices.faults.can.unplugged:
            raise SimulatorStateError("the simulated CAN adapter is unplugged: plug it in")
        self.can_bus.shutdown()
        self.devices.can.clear()
        self.can_bus = InMemoryCanBus(self.devices.can, self.clock, host_bitrate=bitrate)
        return self.can_bus

    def close(self) -> None:
        """Close all buses; the cell cannot be used afterwards."""
        self._closed = True
        for stream in (*self.axes_streams.values(), *self.board_streams):
            stream.close()
        self._servo_port.close()
        self.can_bus.shutdown()
        if self.axes_can_bus is not None:
            self.axes_can_bus.shutdown()
        for callback in (self.devices.advance_to, self.injector.advance):
            if callback in self.clock.on_advance:
                self.clock.on_advance.remove(callback)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def simulated_cell(
    present: str | None = None, *, layout: TaxelLayout | None = None, seed: int = 0
) -> SimulatedCell:
    """Return a simulated cell in virtual time; ``with`` closes its buses.

    `gripper.open_gripper` and `tactile.open_sensor` take its ``servo_port`` and ``can_bus`` instead
    of a port. It has two XM430-W350 on links of 60 mm, and the control unit.

    Parameters
    ----------
    present
        Object between the fingers: oval, cylinder, box, ball or dumbbell; None: no object.
        `SimulatedCell.place` replaces it.
    layout
        The taxels; by default those of the paper: 408 on ten pads.
    seed
        Seed of the noise, and of what differs between its servos.
    """
    cell = SimulatedCell(SimulatorSettings(layout=layout or paper_layout(), seed=seed))
    if present is not None:
        cell.place(present)
    return cell
