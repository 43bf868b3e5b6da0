"""Building the hand of a config: links, sensor and gripper; no simulator."""

import time
from dataclasses import replace

from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig, layout_from_config, link_settings, make_calibration
from cell.hand.connections import HandConnections
from cell.hand.local import LocalHand
from gripper.clock import Clock
from gripper.dynamixel.serial_port import SerialStream
from gripper.gripper import open_gripper
from gripper.values.force_sensor import ForceSample
from tactile.can.bus import open_bus
from tactile.sensor.grip_force import GripForce
from tactile.sensor.opening import open_sensor
from tactile.sensor.quality import QualityLimits
from tactile.sensor.sensor import SensorSettings, TactileSensor
from tactile.sensor.tare import TareLimits
from tactile.source import FrameSource

SHARED_PROCESS = (
    "the force loop shares its process with all other work, which may hold it up: set "
    "loop.own_process to true"
)
"""Note of a real cell whose loop has no process of its own."""

_HELD_SHARE = 0.35
"""Share of the friction by which the wanted force may change while friction holds the one there
is: as that breaks, by a quarter where empty fingers meet, and half as much again."""


def open_hand(
    config: CellConfig, *, notes: tuple[str, ...] = (), partial: bool = False
) -> LocalHand:
    """Open the real ports of a config; nothing moves yet.

    With ``partial`` one of both lines may be missing; a note of the hand names it. Raises
    gripper.errors.PortLost or tactile.errors.LinkFault if a port or bus cannot be opened; with
    ``partial`` if none can.
    """
    gripper, tactile = config.gripper, config.tactile
    lines = HandConnections(
        lambda: SerialStream(gripper.port, gripper.baud_rate),
        lambda: open_bus(tactile.interface, tactile.channel, bitrate=tactile.bitrate),
        partial=partial,
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
    by_current: bool = False,
    source: FrameSource | None = None,
    clock: Clock = time,
) -> LocalHand:
    """Put gripper and sensor together on open lines, which the hand closes at its end.

    Parameters
    ----------
    by_current
        Whether the force follows from the motors' current; the sensor must not be used then.
    source, clock
        Frame source in the place of the configured control unit, and its time.
    """
    settings = sensor_settings(config.tactile, config.friction_n)
    if source is not None:
        calibration = make_calibration(config.tactile, source.layout)
        sensor = TactileSensor(source, calibration, clock=clock, settings=settings)
    else:
        layout = layout_from_config(config.tactile)
        sensor = open_sensor(
            lines.can_bus,
            layout,
            make_calibration(config.tactile, layout),
            node_id=config.tactile.node_id,
            link=link_settings(config.tactile),
            settings=settings,
            reopen=lines.reopen_can,
        )
    force = GripForce(sensor, ForceSample)
    gripper = open_gripper(
        lines.stream,
        config.gripper_settings,
        config.linkage,
        baud_rate=config.gripper.baud_rate,
        force_sensor=None if by_current else force,
    )
    return LocalHand(
        gripper=gripper, sensor=sensor, force=force, lines=lines, notes=(*notes, *config.notes)
    )


def sensor_settings(config: TactileConfig, friction_n: float = 0.0) -> SensorSettings:
    """Return the settings of the way from frames to forces, of fingers with a friction in N."""
    limits = QualityLimits(drift_share=config.drift_max_share)
    step_n = max(limits.force_step_n, _HELD_SHARE * friction_n)
    return SensorSettings(
        bad_share=config.bad_taxels_max_share,
        quality=replace(limits, force_step_n=step_n),
        tare_limits=TareLimits(bad_share=config.bad_taxels_max_share),
    )
