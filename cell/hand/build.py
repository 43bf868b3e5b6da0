"""Building the hand of a config: links, sensor and gripper; no simulator."""

from dataclasses import replace

from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig, layout_from_config, link_settings, make_calibration
from cell.hand.lines import Lines
from cell.hand.local import LocalHand, SensorTap
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.serial_port import SerialStream
from gripper.gripper import Gripper
from gripper.state import Clock
from tactile.can.bus import CanBus
from tactile.layout import TaxelLayout
from tactile.sensor.force_check import force_table
from tactile.sensor.quality import QualityLimits
from tactile.sensor.sensor import SensorSettings, TactileSensor
from tactile.sensor.tare import TareLimits
from tactile.unit.link import TactileLink, open_bus

SHARED_PROCESS = (
    "the force loop shares its process with all other work, which may hold it up: set "
    "loop.own_process to true"
)
"""Note of a real cell whose loop has no process of its own."""


def open_hand(
    config: CellConfig, clock: Clock, *, notes: tuple[str, ...] = (), partial: bool = False
) -> LocalHand:
    """Open the real ports of a config; nothing moves yet.

    Parameters
    ----------
    config
        The cell.
    clock
        Real time.
    notes
        Of the hand.
    partial
        Whether one of both lines may be missing; a note of the hand names it.

    Raises
    ------
    gripper.errors.PortLost, tactile.errors.LinkFault
        If a port or bus cannot be opened; with ``partial`` if none can.
    """
    gripper, tactile = config.gripper, config.tactile
    lines = Lines(
        lambda: SerialStream(gripper.port, gripper.baud_rate),
        lambda: open_bus(tactile.interface, tactile.channel, bitrate=tactile.bitrate),
        partial=partial,
    )
    try:
        return make_hand(
            config, clock=clock, lines=lines, threaded=True, notes=(*notes, *lines.notes)
        )
    except BaseException:
        lines.close()
        raise


def make_hand(
    config: CellConfig,
    *,
    clock: Clock,
    lines: Lines,
    threaded: bool,
    notes: tuple[str, ...] = (),
) -> LocalHand:
    """Put gripper and sensor together on open links.

    Parameters
    ----------
    config
        The cell.
    clock
        Source of time.
    lines
        The servos' line and the control unit's bus; the hand closes them at its end.
    threaded
        Whether a thread receives from the bus: True in real time.
    notes
        Of the hand.
    """
    layout = layout_from_config(config.tactile)
    calibration = make_calibration(config.tactile, layout)
    link = make_link(
        config.tactile,
        lines.can_bus,
        layout,
        clock,
        threaded=threaded,
        force_table=force_table(layout, calibration),
    )
    sensor = TactileSensor(
        link,
        layout,
        calibration,
        clock=clock,
        settings=_sensor_settings(config.tactile),
        forces=link,
    )
    tap = SensorTap(sensor)
    bus = ServoBus(
        lines.stream,
        baudrate=config.gripper.baud_rate,
        clock=clock,
        period_s=1.0 / config.gripper.loop_rate_hz,
        name=f"the servo line ({config.gripper.port})",
    )
    gripper = Gripper(bus, config.linkage, config.gripper_settings, clock=clock, force_sensor=tap)
    return LocalHand(
        gripper=gripper,
        sensor=sensor,
        tap=tap,
        bus=bus,
        link=link,
        lines=lines,
        notes=(*notes, *config.notes),
    )


def make_link(
    config: TactileConfig,
    bus: CanBus,
    layout: TaxelLayout,
    clock: Clock,
    *,
    threaded: bool,
    sync_period_s: float | None = None,
    force_table: bytes | None = None,
) -> TactileLink:
    """Return the link to the control unit on an open bus."""
    settings = link_settings(config, threaded=threaded)
    if sync_period_s is not None:
        settings = replace(settings, sync_period_s=sync_period_s)
    return TactileLink(
        bus,
        node_id=config.node_id,
        layout=layout,
        clock=clock,
        settings=settings,
        force_table=force_table,
    )


def _sensor_settings(config: TactileConfig) -> SensorSettings:
    return SensorSettings(
        bad_share=config.bad_taxels_max_share,
        quality=QualityLimits(drift_share=config.drift_max_share),
        tare_limits=TareLimits(bad_share=config.bad_taxels_max_share),
    )
