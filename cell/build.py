"""The composition root: from a config to a cell that runs."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.collect import SensorTap, pad_array
from cell.config import CellConfig, PaperCalibrationConfig, ParallelLinkageConfig, TactileConfig
from cell.controller import CellController
from cell.errors import ConfigError
from cell.layouts import layout_from_config
from cell.pose import Pose
from cell.positioner import (
    CallbackPositioner,
    HostThenSimulated,
    ObjectPlacer,
    OperatorPositioner,
    Positioner,
    SimulatedPositioner,
    SocketPlacer,
)
from cell.recording import Recorder
from cell.simulation import InProcessPlacer, capture_traffic, simulator_settings
from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import PortLost
from gripper.gripper import Gripper
from gripper.kinematics import Linkage, ParallelLinkage, RackPinion
from gripper.port import ByteStream, SerialStream
from gripper.settings import GripperSettings, ServoSettings
from simulator.assembly import SimulatedCell
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
from tactile.sensor import TactileSensor

Mover = Callable[[Pose], Pose | bool | None]


@dataclass(kw_only=True)
class Cell:
    """A cell and what it was built from; `close` ends all of it and keeps the grip.

    Attributes
    ----------
    controller
        Runs the sequences.
    link, bus
        The two links, for statistics.
    realtime
        Whether time passes by itself; in a simulated cell it passes while somebody waits.
    simulated
        The simulated cell, where there is one in this process.
    """

    controller: CellController
    link: TactileLink
    bus: ServoBus
    realtime: bool
    simulated: SimulatedCell | None
    _recorder: Recorder | None
    _closing: ExitStack

    @property
    def recording_path(self) -> Path | None:
        """The recording, if one is made."""
        return None if self._recorder is None else self._recorder.path

    def health(self) -> dict[str, Any]:
        """Return the counters of both links and the loop."""
        frames, servos = self.link.statistics.frames, self.bus.statistics
        loop = self.controller.gripper.statistics
        return {
            "tactile": {
                name: getattr(frames, name)
                for name in ("complete", "lost", "torn", "duplicate", "stale", "short", "corrupt")
            },
            "servo_bus": {
                name: getattr(servos, name)
                for name in ("transactions", "retries", "timeouts", "corrupt", "late")
            },
            "loop": {
                "cycles": loop.cycles,
                "late": loop.late,
                "missed_reads": loop.missed_reads,
                "worst_lateness_s": loop.worst_lateness_s,
            },
            "recording": None
            if self._recorder is None or self._recorder.fault is None
            else str(self._recorder.fault),
        }

    def close(self) -> None:
        """End everything; a held part stays held. A second call does nothing."""
        self._closing.close()


def build_cell(
    config: CellConfig,
    *,
    folder: Path | None = None,
    mover: Mover | None = None,
    ask: Callable[[str], str] | None = None,
    capture: Path | None = None,
) -> Cell:
    """Open the buses of a config and put the cell together; nothing moves yet.

    Parameters
    ----------
    config
        The cell.
    folder
        Where the recording goes; None makes none.
    mover
        Moves for a positioner of kind ``callback``.
    ask
        Asks the operator for a positioner of kind ``operator``.
    capture
        pcap file for the CAN traffic of a simulated cell.

    Raises
    ------
    ConfigError
        If the positioner's kind needs what is not given, or a real bus is to be captured.
    gripper.errors.PortLost, tactile.errors.LinkFault, cell.errors.PositionerError
        If a port, bus or socket cannot be opened.
    """
    layout = layout_from_config(config.tactile)
    with ExitStack() as undo:
        simulated: SimulatedCell | None = None
        clock: Clock = time
        if config.simulated:
            simulated = SimulatedCell(simulator_settings(config), lost_error=PortLost)
            undo.callback(simulated.close)
            clock = simulated.clock
        if capture is not None:
            capture_traffic(simulated, capture, undo)
        positioner = _positioner(config, simulated, mover, ask, undo)
        can_bus = _can_bus(config.tactile, simulated, undo)
        link = make_link(config.tactile, can_bus, layout, clock, threaded=simulated is None)
        sensor = TactileSensor(link, layout, _calibration(config.tactile, layout), clock=clock)
        tap = SensorTap(sensor)
        bus = _servo_bus(config, simulated, clock, undo)
        gripper = Gripper(
            bus, make_linkage(config), gripper_settings(config), clock=clock, force_sensor=tap
        )
        recorder = None
        if folder is not None:
            recorder = Recorder(
                folder / "recording.mcap",
                clock,
                pads=pad_array(layout),
                metadata={"cell": config.name, "config": config.model_dump_json()},
                background=simulated is None,
            )
            undo.callback(recorder.close)
        controller = CellController(
            gripper=gripper,
            sensor=sensor,
            tap=tap,
            positioner=positioner,
            sequence=config.sequence,
            tare_frames=config.tactile.tare_frames,
            clock=clock,
            recorder=recorder,
        )
        undo.callback(controller.shutdown)
        return Cell(
            controller=controller,
            link=link,
            bus=bus,
            realtime=simulated is None,
            simulated=simulated,
            _recorder=recorder,
            _closing=undo.pop_all(),
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
            identity=ExpectedIdentity(serial=config.serial_number),
            threaded=threaded,
        ),
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
        watchdog_s=wanted.watchdog_ms * 1e-3,
        watchdog_self_test=wanted.watchdog_self_test,
    )


def _calibration(config: TactileConfig, layout: TaxelLayout) -> Calibration:
    law = config.calibration
    if isinstance(law, PaperCalibrationConfig):
        return FoamCalibration(adc_max=layout.adc_max, gain=law.gain)
    return LinearCalibration(adc_max=layout.adc_max, force_per_count_n=law.force_per_count_n)


def _can_bus(config: TactileConfig, simulated: SimulatedCell | None, undo: ExitStack) -> CanBus:
    if simulated is not None:
        return simulated.can_bus
    bus = open_bus(config.interface, config.channel, bitrate=config.bitrate)
    undo.callback(close_bus, bus)
    return bus


def _servo_bus(
    config: CellConfig, simulated: SimulatedCell | None, clock: Clock, undo: ExitStack
) -> ServoBus:
    stream: ByteStream
    if simulated is not None:
        stream = simulated.servo_stream
    else:
        stream = SerialStream(config.gripper.port, config.gripper.baud_rate)
        undo.callback(stream.close)
    return ServoBus(
        stream,
        baudrate=config.gripper.baud_rate,
        clock=clock,
        period_s=1.0 / config.gripper.loop_rate_hz,
    )


def _positioner(
    config: CellConfig,
    simulated: SimulatedCell | None,
    mover: Mover | None,
    ask: Callable[[str], str] | None,
    undo: ExitStack,
) -> Positioner:
    placer: ObjectPlacer | None = None
    if config.positioner.socket:
        remote = SocketPlacer(config.positioner.socket)
        undo.callback(remote.close)
        placer = remote
    elif simulated is not None:
        placer = InProcessPlacer(simulated)
    if config.positioner.kind == "callback":
        if mover is None:
            raise ConfigError("positioner.kind is callback: the host program must pass its mover")
        host = CallbackPositioner(mover)
        return host if placer is None else HostThenSimulated(host, SimulatedPositioner(placer))
    if config.positioner.kind == "operator":
        if ask is None:
            raise ConfigError("positioner.kind is operator: there is no terminal to ask at")
        return OperatorPositioner(ask)
    if placer is None:
        raise ConfigError("positioner.kind is simulated, but there is no simulated cell")
    return SimulatedPositioner(placer)
