"""From a config to the hand: links, sensor and gripper; knows no simulator."""

from collections.abc import Callable
from contextlib import ExitStack

from cell.config import CellConfig
from cell.config_gripper import ParallelLinkageConfig
from cell.config_tactile import PaperCalibrationConfig, TactileConfig
from cell.hand_local import LocalHand, SensorTap
from cell.layouts import layout_from_config
from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.gripper import Gripper
from gripper.kinematics import Linkage, ParallelLinkage, RackPinion
from gripper.port import ByteStream, SerialStream
from gripper.settings import ForceLoopSettings, GripperSettings, OverForce, ServoSettings
from tactile.calibration import Calibration, FoamCalibration, LinearCalibration
from tactile.can_bus import CanBus
from tactile.layout import TaxelLayout
from tactile.link import (
    ExpectedIdentity,
    LinkSettings,
    TactileLink,
    close_bus,
    open_bus,
)
from tactile.quality import QualityLimits
from tactile.sensor import SensorSettings, TactileSensor
from tactile.tare import TareLimits

SHARED_PROCESS = (
    "the force loop shares its process with all other work, which may hold it up: set "
    "loop.own_process to true"
)
"""Note of a real cell whose loop has no process of its own."""


def open_hand(config: CellConfig, clock: Clock, *, notes: tuple[str, ...] = ()) -> LocalHand:
    """Open the real ports of a config; nothing moves yet.

    Parameters
    ----------
    config
        The cell.
    clock
        Real time.
    notes
        Of the hand.

    Raises
    ------
    gripper.errors.PortLost, tactile.errors.LinkFault
        If a port or bus cannot be opened.
    """
    with ExitStack() as undo:
        tactile = config.tactile
        can_bus = open_bus(tactile.interface, tactile.channel, bitrate=tactile.bitrate)
        undo.callback(close_bus, can_bus)
        stream = SerialStream(config.gripper.port, config.gripper.baud_rate)
        undo.callback(stream.close)
        return make_hand(
            config,
            clock=clock,
            stream=stream,
            can_bus=can_bus,
            threaded=True,
            close_links=undo.pop_all().close,
            notes=notes,
        )


def make_hand(
    config: CellConfig,
    *,
    clock: Clock,
    stream: ByteStream,
    can_bus: CanBus,
    threaded: bool,
    close_links: Callable[[], None],
    notes: tuple[str, ...] = (),
) -> LocalHand:
    """Put gripper and sensor together on open links.

    Parameters
    ----------
    config
        The cell.
    clock
        Source of time.
    stream, can_bus
        The servos' line and the control unit's bus.
    threaded
        Whether a thread receives from the bus: True in real time.
    close_links
        Closes both; the hand calls it at its end.
    notes
        Of the hand.
    """
    layout = layout_from_config(config.tactile)
    link = make_link(config.tactile, can_bus, layout, clock, threaded=threaded)
    sensor = TactileSensor(
        link,
        layout,
        _calibration(config.tactile, layout),
        clock=clock,
        settings=_sensor_settings(config.tactile),
    )
    tap = SensorTap(sensor)
    bus = ServoBus(
        stream,
        baudrate=config.gripper.baud_rate,
        clock=clock,
        period_s=1.0 / config.gripper.loop_rate_hz,
    )
    gripper = Gripper(
        bus, make_linkage(config), gripper_settings(config), clock=clock, force_sensor=tap
    )
    return LocalHand(
        gripper=gripper,
        sensor=sensor,
        tap=tap,
        bus=bus,
        link=link,
        close_links=close_links,
        notes=notes,
    )


def make_link(
    config: TactileConfig,
    bus: CanBus,
    layout: TaxelLayout,
    clock: Clock,
    *,
    threaded: bool,
    sync_period_s: float | None = None,
) -> TactileLink:
    """Return the link to the control unit on an open bus."""
    return TactileLink(
        bus,
        node_id=config.node_id,
        layout=layout,
        clock=clock,
        settings=LinkSettings(
            sync_period_s=config.sync_period_ms * 1e-3 if sync_period_s is None else sync_period_s,
            heartbeat_s=config.heartbeat_ms * 1e-3,
            startup_timeout_s=config.startup_timeout_s,
            max_loss_rate=config.loss_max_share,
            max_foreign_hz=config.foreign_max_hz,
            identity=ExpectedIdentity(
                serial=config.serial_number, boards=config.board_serial_numbers
            ),
            threaded=threaded,
        ),
    )


def _sensor_settings(config: TactileConfig) -> SensorSettings:
    return SensorSettings(
        bad_share=config.bad_taxels_max_share,
        quality=QualityLimits(drift_share=config.drift_max_share),
        tare_limits=TareLimits(bad_share=config.bad_taxels_max_share),
    )


def make_linkage(config: CellConfig) -> Linkage:
    """Return the linkage of a config."""
    drive, n_servos = config.gripper.linkage, len(config.gripper.servos)
    if isinstance(drive, ParallelLinkageConfig):
        return ParallelLinkage(
            link_m=drive.link_mm * 1e-3, offset_m=drive.offset_mm * 1e-3, n_servos=n_servos
        )
    return RackPinion(
        pinion_radius_m=drive.pinion_radius_mm * 1e-3,
        offset_m=drive.offset_mm * 1e-3,
        n_servos=n_servos,
    )


def gripper_settings(config: CellConfig) -> GripperSettings:
    """Return the limits and tuning of a config. Raises gripper.errors.LimitExceeded."""
    wanted = config.gripper
    return GripperSettings(
        servos=tuple(
            ServoSettings(
                servo_id=servo.id,
                model=servo.model,
                direction=servo.direction,
                zero_raw=servo.zero_pulse,
            )
            for servo in wanted.servos
        ),
        loop_rate_hz=wanted.loop_rate_hz,
        aperture_open_m=wanted.aperture_open_mm * 1e-3,
        aperture_min_m=wanted.aperture_min_mm * 1e-3,
        approach_speed_m_s=wanted.approach_speed_mm_s * 1e-3,
        contact_force_n=wanted.contact_force_n,
        contact_timeout_s=wanted.contact_timeout_s,
        force_max_n=wanted.force_max_n,
        current_max_a=wanted.current_max_a,
        temperature_max_c=wanted.temperature_max_c,
        force_stale_s=wanted.force_stale_ms * 1e-3,
        bus_loss_s=wanted.bus_loss_ms * 1e-3,
        stall_max_s=wanted.stall_max_ms * 1e-3,
        watchdog_s=wanted.watchdog_ms * 1e-3,
        watchdog_self_test=wanted.watchdog_self_test,
        overruns_max=config.loop.overruns_max,
        open_speed_m_s=wanted.open_speed_mm_s * 1e-3,
        approach_force_n=wanted.contact.approach_force_n,
        contact_samples=wanted.contact.samples,
        settle_timeout_s=wanted.settle.timeout_s,
        settle_tolerance_n=wanted.settle.tolerance_n,
        settle_tolerance_share=wanted.settle.tolerance_share,
        slip_drop_n=wanted.slip.drop_n,
        slip_drop_share=wanted.slip.drop_share,
        slip_travel_m=wanted.slip.travel_mm * 1e-3,
        slide_m=wanted.slip.slide_mm * 1e-3,
        runaway_speed_m_s=wanted.slip.runaway_mm_s * 1e-3,
        runaway_travel_m=wanted.slip.runaway_mm * 1e-3,
        imbalance_n=wanted.imbalance.difference_n,
        imbalance_share=wanted.imbalance.difference_share,
        imbalance_s=wanted.imbalance.time_s,
        over_force=OverForce(wanted.over_force.reaction),
        force_noise_n=wanted.over_force.noise_n,
        over_force_share=wanted.over_force.left_share,
        over_force_open_m=wanted.over_force.open_mm * 1e-3,
        temperature_derate_k=wanted.servo_care.derate_c,
        taper_after_s=wanted.servo_care.taper_after_s,
        corrected_registers=frozenset(wanted.servo_care.corrected_registers),
        force_loop=ForceLoopSettings(taper_n_s=wanted.servo_care.taper_n_s),
    )


def _calibration(config: TactileConfig, layout: TaxelLayout) -> Calibration:
    law = config.calibration
    if isinstance(law, PaperCalibrationConfig):
        return FoamCalibration(adc_max=layout.adc_max, gain=law.gain)
    return LinearCalibration(adc_max=layout.adc_max, force_per_count_n=law.force_per_count_n)
