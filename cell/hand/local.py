"""The hand in this process: its loop runs in the caller's thread; no simulator."""

import functools
import time
from collections.abc import Callable
from dataclasses import replace

from cell.config.gripper import use_servo_models
from cell.config.model import CellConfig
from cell.config.sensor import SensorLines
from cell.config.tactile import TactileConfig, layout_from_config, make_calibration
from cell.hand.connections import HandConnections
from cell.hand.interface import HandStatistics, LatestValues, OnPeriod
from cell.plugins import SENSORS
from cell.sensors.guard import GuardedSource
from gripper.clock import Clock
from gripper.dynamixel.serial_port import ByteStream, SerialStream
from gripper.errors import PortLost
from gripper.force.ramp import ForceRamp, largest_ramp_n
from gripper.gripper import open_gripper
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspOutcome, ReleaseReport
from gripper.values.state import Cycle, GripperPhase, TimeSpan
from tactile.can.bus import CanBus, MissingBus, open_bus
from tactile.errors import BusOff, ZeroDrifted
from tactile.sensor.grip_force import GripForce
from tactile.sensor.sensor import TactileReading, TactileSensor
from tactile.sensor.settings import SensorSettings
from tactile.sensor.tare import TareResult
from tactile.source import FrameSource, SourceIdentity

SHARED_PROCESS = (
    "the force loop shares its process with all other work, which may delay it: set "
    "loop.own_process to true"
)
"""Note of a real cell whose loop has no process of its own."""

_HELD_SHARE = 0.35
"""Share of the friction by which the set-point may change before the force follows, because
friction holds the force: a quarter where empty fingers meet, and half as much again."""


class LocalHand:
    """Implements `cell.hand.interface.Hand` in the caller's thread.

    Gripper, sensor and the servos' ``bus`` are public for tests and benchmarks; send commands
    through the hand.

    Parameters
    ----------
    config
        The cell.
    lines
        Open lines of gripper and sensor; the hand closes them at its end.
    notes
        Messages for the operator, before those of the config.
    clock
        Clock of the lines.
    """

    own_process = False

    def __init__(
        self,
        config: CellConfig,
        lines: HandConnections,
        *,
        notes: tuple[str, ...] = (),
        clock: Clock = time,
    ) -> None:
        sensor_lines = SensorLines(
            clock=clock,
            open_serial=lines.open_boards,
            can_bus=lines.can_bus,
            reopen_can=lines.reopen_can,
        )
        self.sensor = sensor = taxel_sensor(config.tactile, sensor_lines, config.friction_n)
        self._force = GripForce(sensor, ForceSample)
        self.gripper = gripper = open_gripper(
            lines.stream,
            config.gripper_settings,
            config.linkage,
            baud_rate=config.gripper.baud_rate,
            force_sensor=self._force,
        )
        self.bus = gripper.bus
        self.layout, self.period_s = sensor.layout, gripper.settings.period_s
        self.notes, self.missing = (*notes, *config.notes), lines.missing
        self.latest = LatestValues()
        self._lines = lines
        self.start = gripper.start
        self.read_drives, self.use_drives = gripper.read_drives, gripper.use_drives
        self.conditions = gripper.conditions
        self.inspect = gripper.inspect
        self.check_ramp = gripper.check_ramp
        self.end_ramp = gripper.end_ramp
        self.keep_grip = gripper.keep_grip
        self.request_stop = gripper.request_stop
        self.stop_sensor = sensor.stop

    @property
    def phase(self) -> GripperPhase:
        """Phase of the gripper."""
        return self.gripper.phase

    @property
    def statistics(self) -> HandStatistics:
        """Counters of loop and links."""
        return HandStatistics(
            loop=self.gripper.statistics,
            servo_bus=self.bus.statistics,
            source=self.sensor.source.statistics,
            sensor=self.sensor.statistics,
        )

    @property
    def largest_ramp_n(self) -> float:
        """Largest force in N of a ramp; see `Hand`."""
        return largest_ramp_n(self.gripper.mechanics)

    def start_sensor(self) -> SourceIdentity:
        """Start the tactile link; see `Hand`."""
        try:
            return self.sensor.start()
        except BusOff:
            # A link at rest did not see that its adapter was exchanged: this start opens it anew.
            self.stop_sensor()
            return self.sensor.start()

    def open(self, watch: OnPeriod) -> None:
        """Open the empty fingers; see `Hand`."""
        self.gripper.open(observer=self._observer(watch))

    def tare(self, n_frames: int) -> TareResult:
        """Take the zero of the taxels; see `Hand`."""
        zero = self.sensor.tare(n_frames)
        # No force is measured before all frames of the mean count from this zero.
        self.sensor.refresh()
        return zero

    def grasp(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Close and follow the ramp; see `Hand`."""
        self._check_zero()
        return self.gripper.grasp(ramp, observer=self._observer(watch))

    def press_pads_together(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Close the empty fingers onto each other; see `Hand`."""
        self._check_zero()
        return self.gripper.press_pads_together(ramp, observer=self._observer(watch))

    def measure_load(self, watch: OnPeriod) -> tuple[TimeSpan, ...]:
        """Measure the servos' currents for their load; see `Hand`."""
        return self.gripper.measure_load(self._observer(watch))

    def measure_friction(self, watch: OnPeriod) -> None:
        """Measure the servos' friction; see `Hand`."""
        self.gripper.measure_friction(self._observer(watch))

    def hold_at(self, force_n: float, duration_s: float, watch: OnPeriod) -> None:
        """Hold the part with another force; see `Hand`."""
        self.gripper.hold_at(force_n, duration_s, self._observer(watch))

    def squeeze(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Follow a further ramp in the same grip; see `Hand`."""
        return self.gripper.squeeze(ramp, self._observer(watch))

    def release(self, watch: OnPeriod | None = None) -> ReleaseReport:
        """Let go; see `Hand`."""
        report = self.gripper.release(observer=None if watch is None else self._observer(watch))
        try:
            self._check_zero()
        except ZeroDrifted:
            # The mean may still include frames from before the fingers left the part.
            self.sensor.refresh()
            self._check_zero()
        return report

    def read_sensor(self, timeout_s: float) -> TactileReading:
        """Wait for a new reading of the taxels."""
        return self.sensor.read(timeout_s=timeout_s)

    def tick(self) -> None:
        """Serve and supervise both links; see `Hand`."""
        cycle = self.gripper.tick()
        if cycle is not None and cycle.force is not None:
            self._aim(cycle)
        force = self._force.latest_force()
        self.latest = self.latest.then(cycle, force, self._force.take())

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos; a port that is lost is opened again."""
        try:
            self.gripper.clear_fault(reboot=reboot)
        except PortLost:
            self.bus.port.use(self._lines.reopen_servos())
            self.gripper.clear_fault(reboot=reboot)

    def shutdown(self) -> str:
        """Leave servos and sensor in a defined state; see `Hand`."""
        self.gripper.close()
        self.stop_sensor()
        return ""

    def close(self) -> None:
        """Close the ports."""
        self._lines.close()

    def _observer(self, watch: OnPeriod) -> Callable[[Cycle], None]:
        """Return the observer of one command; frames from before it are left out."""
        self._force.take()

        def observe(cycle: Cycle) -> None:
            self._aim(cycle)
            frames = self._force.take()
            self.latest = self.latest.then(cycle, cycle.force, frames)
            watch(cycle, frames)

        return observe

    def _aim(self, cycle: Cycle) -> None:
        self.sensor.aim(cycle.setpoint_n, cycle.state.aperture_m)

    def _check_zero(self) -> None:
        """Refuse to measure with a zero that has moved, while the fingers are open."""
        if self.sensor.running:
            self.sensor.check_zero()


def open_hand(
    config: CellConfig,
    *,
    notes: tuple[str, ...] = (),
    partial: bool = False,
    clock: Clock = time,
    open_serial: Callable[[str, int], ByteStream] = SerialStream,
    open_can: Callable[..., CanBus] = open_bus,
) -> LocalHand:
    """Open the ports of a config; nothing moves yet.

    With ``partial`` one of both lines may be missing; `Hand.missing` names it. Raises
    gripper.errors.PortLost or tactile.errors.LinkFault if a port or bus cannot be opened; with
    ``partial`` only if both cannot be opened.

    Parameters
    ----------
    clock
        Clock of the lines.
    open_serial, open_can
        Open a serial port and a CAN bus: by default those of this machine.
    """
    gripper, tactile = config.gripper, config.tactile
    # A config that another process has checked comes without what its check has loaded.
    use_servo_models(servo.model for servo in gripper.servos)
    lines = HandConnections(
        lambda: open_serial(gripper.port, gripper.baud_rate),
        lambda: (
            MissingBus()
            if not tactile.sensor.on_can
            else open_can(tactile.interface, tactile.channel, bitrate=tactile.bitrate)
        ),
        partial=partial,
        open_boards=[
            functools.partial(open_serial, port, tactile.sensor.baud_rate)
            for port in tactile.serial_ports
        ],
    )
    try:
        return LocalHand(config, lines, notes=notes, clock=clock)
    except BaseException:
        lines.close()
        raise


def taxel_sensor(
    config: TactileConfig, lines: SensorLines, friction_n: float = 0.0
) -> TactileSensor:
    """Return the sensor of a config, not started, for fingers with a friction in N."""
    source, settings = frame_source(config, lines), sensor_settings(config, friction_n)
    calibration = make_calibration(config, source.layout)
    return TactileSensor(source, calibration, clock=lines.clock, settings=settings)


def frame_source(config: TactileConfig, lines: SensorLines) -> FrameSource:
    """Return the frame source of a config, not started; that of another package is guarded."""
    kind = config.sensor.kind
    if SENSORS.built_in(kind):
        return config.sensor.open_source(config, lines)
    return GuardedSource(
        lambda: config.sensor.open_source(config, lines),
        name=f"sensor {kind} of {SENSORS.package(kind)}",
        layout=layout_from_config(config),
        clock=lines.clock,
    )


def sensor_settings(config: TactileConfig, friction_n: float = 0.0) -> SensorSettings:
    """Return the settings that convert frames to forces, for fingers with a friction in N."""
    rest = config.sensor.rest
    return replace(
        rest,
        drift_share=config.drift_max_share,
        bad_share=config.bad_taxels_max_share,
        force_step_n=max(rest.force_step_n, _HELD_SHARE * friction_n),
    )
