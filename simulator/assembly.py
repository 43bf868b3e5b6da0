"""The simulated cell: one world, the devices in it, and the ends of their buses in memory."""

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from simulator.can_bus import InMemoryCanBus
from simulator.can_faults import CanLinkFaults, ControlUnitFaults
from simulator.clock import VirtualClock
from simulator.control_unit import ControlUnitSettings, SimulatedControlUnit
from simulator.errors import PortUnplugged, SimulatorSettingsError, SimulatorStateError
from simulator.mechanics import FingerMechanics
from simulator.motor import ServoMotor
from simulator.recorded import RecordedWorld
from simulator.servo import BAUD_RATES, SimulatedServo
from simulator.servo_bus import ServoBusDevice
from simulator.servo_faults import ServoFaultKnobs, WireFaults
from simulator.servo_stream import MemoryServoStream
from simulator.settings import SimulatorSettings
from simulator.shapes import ObjectPose
from simulator.world import PhysicalWorld, WorldSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class CellFaults:
    """All fault knobs of a simulated cell; all are off until they are turned.

    Attributes
    ----------
    servo_wire
        The line between host and servos.
    servos
        The servos by their ID.
    can
        The way between control unit and host.
    unit
        The control unit.
    """

    servo_wire: WireFaults
    servos: dict[int, ServoFaultKnobs]
    can: CanLinkFaults
    unit: ControlUnitFaults


class CellDevices:
    """World and devices, without the ends of the buses: what both kinds of time share.

    Parameters
    ----------
    settings
        What the cell is made of.
    start_s
        Time at the start in s.

    Attributes
    ----------
    mechanics
        The fingers.
    world
        What is between them.
    servo_bus
        The servos on their line.
    unit
        The control unit.
    faults
        The knobs.
    """

    __slots__ = ("faults", "mechanics", "servo_bus", "settings", "unit", "world")

    def __init__(self, settings: SimulatorSettings, *, start_s: float = 0.0) -> None:
        self.settings = settings
        motors = [ServoMotor(servo.model) for servo in settings.servos]
        self.mechanics = FingerMechanics(
            motors,
            [servo.mount for servo in settings.servos],
            settings.linkage,
            aperture_m=settings.aperture_m,
        )
        self.world = self._make_world(start_s)
        if settings.servo_baud_rate not in BAUD_RATES:
            raise SimulatorSettingsError(
                f"servo_baud_rate is {settings.servo_baud_rate}, must be one of {BAUD_RATES}"
            )
        eeprom = {
            "baud_rate": BAUD_RATES.index(settings.servo_baud_rate),
            "return_delay_time": 0,
        }
        servos = [
            SimulatedServo(entry.servo_id, entry.model, motor, settings=eeprom)
            for entry, motor in zip(settings.servos, motors, strict=True)
        ]
        self.servo_bus = ServoBusDevice(servos, settings.servo_baud_rate)
        self.servo_bus.faults.seed = settings.seed
        unit_faults = ControlUnitFaults()
        self.unit = SimulatedControlUnit(
            self.world,
            settings.layout,
            ControlUnitSettings(
                node_id=settings.node_id,
                bitrate=settings.can_bitrate,
                serial_number=settings.serial_number,
            ),
            faults=unit_faults,
            start_s=start_s,
        )
        self.faults = CellFaults(
            servo_wire=self.servo_bus.faults,
            servos={
                servo.servo_id: ServoFaultKnobs(servo, motor)
                for servo, motor in zip(servos, motors, strict=True)
            },
            can=CanLinkFaults(),
            unit=unit_faults,
        )

    def _make_world(self, start_s: float) -> PhysicalWorld | RecordedWorld:
        settings = self.settings
        if settings.grasps:
            return RecordedWorld(settings.layout, self.mechanics, start_s=start_s)
        return PhysicalWorld(
            settings.layout,
            self.mechanics,
            WorldSettings(
                foam=settings.foam,
                noise=settings.noise,
                seed=settings.seed,
                objects=settings.objects,
            ),
            start_s=start_s,
        )

    @property
    def physical(self) -> PhysicalWorld:
        """The world with objects; SimulatorStateError in a cell that plays recorded grasps."""
        if isinstance(self.world, PhysicalWorld):
            return self.world
        raise SimulatorStateError("this cell plays recorded grasps: it has no objects to place")

    @property
    def recorded(self) -> RecordedWorld:
        """The world that plays grasps; SimulatorStateError in a cell with objects."""
        if isinstance(self.world, RecordedWorld):
            return self.world
        raise SimulatorStateError("this cell presses objects into foam: it has no grasps to play")

    def play(self, index: int) -> int:
        """Load one of the settings' grasps; returns the number of its frames.

        Raises
        ------
        SimulatorSettingsError
            If there is no such grasp, or it does not fit the layout.
        """
        recorded, grasps = self.recorded, self.settings.grasps
        if not 0 <= index < len(grasps):
            raise SimulatorSettingsError(f"grasp {index} does not exist, there are {len(grasps)}")
        recorded.load(grasps[index].counts, grasps[index].aperture_m)
        return recorded.remaining

    def advance_to(self, now_s: float) -> None:
        """Let the time pass for fingers, object and servos until ``now_s`` s."""
        self.world.advance_to(now_s)
        self.servo_bus.advance_to(now_s)


class SimulatedCell:
    """The simulated cell in virtual time: everything in one thread, as fast as the machine goes.

    Parameters
    ----------
    settings
        What the cell is made of.
    clock
        Its time; inject the same one into everything that talks to the cell.
    lost_error
        Makes the exception that `servo_stream` raises while its cable is out, from a text.

    Attributes
    ----------
    settings, clock
        As given.
    devices
        World and devices.
    servo_stream
        The host's end of the servo bus.
    can_bus
        The host's end of the CAN bus.
    """

    def __init__(
        self,
        settings: SimulatorSettings | None = None,
        clock: VirtualClock | None = None,
        *,
        lost_error: Callable[[str], Exception] = PortUnplugged,
    ) -> None:
        self.settings = settings or SimulatorSettings()
        self.clock = clock or VirtualClock()
        self.devices = CellDevices(self.settings, start_s=self.clock.monotonic())
        self.clock.on_advance.append(self.devices.advance_to)
        self.servo_stream = MemoryServoStream(
            self.devices.servo_bus, self.clock, lost_error=lost_error
        )
        self.can_bus = InMemoryCanBus(
            self.devices.unit,
            self.clock,
            bitrate=self.settings.can_bitrate,
            faults=self.devices.faults.can,
            seed=self.settings.seed,
        )

    @property
    def world(self) -> PhysicalWorld | RecordedWorld:
        """What is between the fingers."""
        return self.devices.world

    @property
    def recorded(self) -> RecordedWorld:
        """The world that plays grasps; see `CellDevices.recorded`."""
        return self.devices.recorded

    @property
    def unit(self) -> SimulatedControlUnit:
        """The control unit."""
        return self.devices.unit

    @property
    def faults(self) -> CellFaults:
        """The fault knobs."""
        return self.devices.faults

    def place(self, label: str, pose: ObjectPose | None = None) -> ObjectPose:
        """Put an object between the open pads; see `PhysicalWorld.place`."""
        return self.devices.physical.place(label, pose)

    def remove(self) -> None:
        """Take the object away."""
        self.devices.physical.remove()

    def play(self, index: int) -> int:
        """Load one of the settings' grasps; see `CellDevices.play`."""
        return self.devices.play(index)

    def close(self) -> None:
        """Give both buses back; the cell cannot be used afterwards."""
        self.servo_stream.close()
        self.can_bus.shutdown()
        if self.devices.advance_to in self.clock.on_advance:
            self.clock.on_advance.remove(self.devices.advance_to)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
