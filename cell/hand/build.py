"""Building the hand of a config: links, sensor and gripper; no simulator."""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from cell.config.model import CellConfig
from cell.config.tactile import (
    FlexiTacConfig,
    TactileConfig,
    UskinConfig,
    board_ids,
    layout_from_config,
    link_settings,
    make_calibration,
    pad_mounts,
)
from cell.hand.connections import HandConnections
from cell.hand.local import LocalHand
from gripper.clock import Clock
from gripper.dynamixel.serial_port import SerialStream
from gripper.errors import PortLost
from gripper.gripper import open_gripper
from gripper.values.force_sensor import ForceSample
from tactile.can.bus import CanBus, MissingBus, open_bus
from tactile.flexitac.source import BoardLine, FlexiTacSource
from tactile.flexitac.stream import BAUD_RATE, PROFILES
from tactile.sensor.grip_force import GripForce
from tactile.sensor.opening import open_sensor
from tactile.sensor.quality import QualityLimits
from tactile.sensor.sensor import SensorSettings, TactileSensor
from tactile.sensor.tare import TareLimits
from tactile.source import FrameSource
from tactile.uskin.source import UskinSource

SHARED_PROCESS = (
    "the force loop shares its process with all other work, which may delay it: set "
    "loop.own_process to true"
)
"""Note of a real cell whose loop has no process of its own."""

_HELD_SHARE = 0.35
"""Share of the friction by which the set-point may change before the force follows, because
friction holds the force: a quarter where empty fingers meet, and half as much again."""

_MATRIX_REST_SHARE, _MATRIX_BUMP_SHARE = 0.22, 0.05
"""Of the full scale: taxels of a resistive matrix rest at 10 to 40 of 255 counts, each different.
The mean of nine may differ this far from that of the pad by chance. [derived]"""
_MAGNET_REST_SHARE, _MAGNET_NOISE_SHARE = 0.75, 4e-4
"""Of the full scale: z of a uSkin taxel rests at 9312h, and 26 counts are 0.01 N. [derived]"""
_MATRIX_STUCK_FRAMES = 100
"""Frames in which an 8-bit taxel may repeat its value: a second. [chosen]"""


def open_hand(
    config: CellConfig, *, notes: tuple[str, ...] = (), partial: bool = False
) -> LocalHand:
    """Open the real ports of a config; nothing moves yet.

    With ``partial`` one of both lines may be missing; a note of the hand names it. Raises
    gripper.errors.PortLost or tactile.errors.LinkFault if a port or bus cannot be opened; with
    ``partial`` only if both cannot be opened.
    """
    gripper, tactile = config.gripper, config.tactile
    lines = HandConnections(
        lambda: SerialStream(gripper.port, gripper.baud_rate),
        lambda: (
            MissingBus()
            if tactile.serial_ports
            else open_bus(tactile.interface, tactile.channel, bitrate=tactile.bitrate)
        ),
        partial=partial,
        open_boards=[
            functools.partial(SerialStream, port, BAUD_RATE) for port in tactile.serial_ports
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
    by_current: bool = False,
    source: FrameSource | None = None,
    clock: Clock = time,
) -> LocalHand:
    """Return a hand of gripper and sensor on open lines, which the hand closes at its end.

    Parameters
    ----------
    by_current
        Whether the force is computed from the motors' current; do not use the sensor then.
    source, clock
        Frame source instead of the configured control unit, and its clock.
    """
    settings = sensor_settings(config.tactile, config.friction_n)
    source = source or board_source(
        config.tactile,
        clock,
        open_boards=lines.open_boards,
        can_bus=lines.can_bus,
        reopen=lines.reopen_can,
    )
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


def board_source(
    config: TactileConfig,
    clock: Clock,
    *,
    open_boards: Sequence[Callable[[], BoardLine]] = (),
    can_bus: CanBus | None = None,
    reopen: Callable[[], CanBus] | None = None,
) -> FrameSource | None:
    """Return the frame source of sensor boards on these lines; None for the control unit."""
    common: dict[str, Any] = {
        "layout": layout_from_config(config),
        "clock": clock,
        "mounts": pad_mounts(config),
        "silence_s": 1e-3 * config.silence_ms,
        "max_loss_rate": config.loss_max_share,
        "startup_timeout_s": config.startup_timeout_s,
    }
    if isinstance(config.sensor, FlexiTacConfig):
        return FlexiTacSource(
            open_boards,
            profile=PROFILES[config.sensor.profile],
            rows_along=config.sensor.rows_along,
            line_errors=(OSError, PortLost),
            **common,
        )
    if isinstance(config.sensor, UskinConfig) and can_bus is not None:
        return UskinSource(
            can_bus,
            board_ids(config.sensor),
            falling=config.sensor.falling,
            threaded=clock is time,
            reopen=reopen,
            **common,
        )
    return None


def sensor_settings(config: TactileConfig, friction_n: float = 0.0) -> SensorSettings:
    """Return the settings that convert frames to forces, for fingers with a friction in N."""
    limits = QualityLimits(drift_share=config.drift_max_share)
    tare = TareLimits(bad_share=config.bad_taxels_max_share)
    if isinstance(config.sensor, FlexiTacConfig):
        limits = replace(limits, stuck_frames=_MATRIX_STUCK_FRAMES)
        tare = replace(tare, offset_share=_MATRIX_REST_SHARE, bump_share=_MATRIX_BUMP_SHARE)
    noise_floor_share = SensorSettings().noise_floor_share
    if isinstance(config.sensor, UskinConfig):
        noise_floor_share = _MAGNET_NOISE_SHARE
        tare = replace(tare, offset_share=_MAGNET_REST_SHARE, bump_share=_MATRIX_BUMP_SHARE)
    step_n = max(limits.force_step_n, _HELD_SHARE * friction_n)
    return SensorSettings(
        noise_floor_share=noise_floor_share,
        bad_share=config.bad_taxels_max_share,
        quality=replace(limits, force_step_n=step_n),
        tare_limits=tare,
    )
