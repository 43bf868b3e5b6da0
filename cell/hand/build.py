"""Building the hand of a config: links, sensor and gripper; no simulator."""

import functools
import time
from dataclasses import asdict

from cell.config.gripper import use_servo_models
from cell.config.model import CellConfig
from cell.config.sensor import SensorLines
from cell.config.tactile import TactileConfig, layout_from_config, make_calibration
from cell.hand.connections import HandConnections
from cell.hand.local import LocalHand
from cell.plugins import SENSORS
from cell.sensors.guard import GuardedSource
from gripper.clock import Clock
from gripper.dynamixel.serial_port import SerialStream
from gripper.gripper import open_gripper
from gripper.values.force_sensor import ForceSample
from tactile.can.bus import MissingBus, open_bus
from tactile.sensor.grip_force import GripForce
from tactile.sensor.sensor import TactileSensor
from tactile.sensor.settings import SensorSettings
from tactile.source import FrameSource

SHARED_PROCESS = (
    "the force loop shares its process with all other work, which may delay it: set "
    "loop.own_process to true"
)
"""Note of a real cell whose loop has no process of its own."""

_HELD_SHARE = 0.35
"""Share of the friction by which the set-point may change before the force follows, because
friction holds the force: a quarter where empty fingers meet, and half as much again."""


def open_hand(
    config: CellConfig, *, notes: tuple[str, ...] = (), partial: bool = False
) -> LocalHand:
    """Open the real ports of a config; nothing moves yet.

    With ``partial`` one of both lines may be missing; a note of the hand names it. Raises
    gripper.errors.PortLost or tactile.errors.LinkFault if a port or bus cannot be opened; with
    ``partial`` only if both cannot be opened.
    """
    gripper, tactile = config.gripper, config.tactile
    # A config that another process has checked comes without what its check has loaded.
    use_servo_models(servo.model for servo in gripper.servos)
    lines = HandConnections(
        lambda: SerialStream(gripper.port, gripper.baud_rate),
        lambda: (
            MissingBus()
            if not tactile.sensor.on_can
            else open_bus(tactile.interface, tactile.channel, bitrate=tactile.bitrate)
        ),
        partial=partial,
        open_boards=[
            functools.partial(SerialStream, port, tactile.sensor.baud_rate)
            for port in tactile.serial_ports
        ],
    )
    try:
        return make_hand(config, lines, notes=(*notes, *lines.notes))
    except BaseException:
        lines.close()
        raise


def make_hand(
    config: CellConfig,
    lines: HandConnections,
    *,
    notes: tuple[str, ...] = (),
    clock: Clock = time,
) -> LocalHand:
    """Return a hand of gripper and sensor on open lines, which the hand closes at its end.

    Parameters
    ----------
    clock
        Clock of the lines.
    """
    settings = sensor_settings(config.tactile, config.friction_n)
    source = frame_source(
        config.tactile,
        SensorLines(
            clock=clock,
            open_serial=lines.open_boards,
            can_bus=lines.can_bus,
            reopen_can=lines.reopen_can,
            real_time=clock is time,
        ),
    )
    calibration = make_calibration(config.tactile, source.layout)
    sensor = TactileSensor(source, calibration, clock=clock, settings=settings)
    force = GripForce(sensor, ForceSample)
    gripper = open_gripper(
        lines.stream,
        config.gripper_settings,
        config.linkage,
        baud_rate=config.gripper.baud_rate,
        force_sensor=force,
    )
    return LocalHand(
        gripper=gripper, sensor=sensor, force=force, lines=lines, notes=(*notes, *config.notes)
    )


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
    of_kind = {name: one for name, one in asdict(config.sensor.rest).items() if one is not None}
    return SensorSettings(
        drift_share=config.drift_max_share,
        bad_share=config.bad_taxels_max_share,
        force_step_n=max(SensorSettings().force_step_n, _HELD_SHARE * friction_n),
        **of_kind,
    )
