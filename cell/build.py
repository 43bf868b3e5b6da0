"""Building a cell: from a config to buses, controller, positioner and recorder."""

import functools
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, assert_never

from cell.config.model import CellConfig
from cell.config.positioner import ServoAxisConfig
from cell.control.axes import AxesPositioner, drive_axes, servo_axis
from cell.control.controller import CellController
from cell.control.journal import Journal, counters
from cell.control.plan import Pose
from cell.control.positioner import (
    CallbackPositioner,
    CarryCallback,
    HostPlaces,
    ObjectPlacer,
    OperatorPositioner,
    PatientCaller,
    Positioner,
    SimulatedPositioner,
    SocketPlacer,
    Supervise,
)
from cell.control.records import pad_array
from cell.control.zeroing import stored_zeros
from cell.errors import ConfigError, RecordingError
from cell.hand.client import HandProcess
from cell.hand.connections import HandConnections
from cell.hand.interface import Hand
from cell.hand.local import SHARED_PROCESS, LocalHand, open_hand
from cell.recording.recorder import Recorder
from cell.recording.retention import Retention
from cell.simulation import InProcessPlacer, open_can_bus, open_servo_port, simulation_of
from gripper.clock import Clock
from gripper.dynamixel.serial_port import ByteStream, SerialStream
from gripper.values.state import GripperPhase
from motion.axes import Axes, Watch
from simulator.cell import SimulatedCell
from simulator.clock import Pace
from tactile.can.bus import CanBus, close_bus, open_bus

_IDLE_STEP_S = 0.02
"""Virtual time in s between two checks of a paced cell with empty fingers: one frame."""

Mover = Callable[[Pose], Pose | bool | None]
"""Moves to a pose: returns None or True when reached, False to refuse, or the reached pose."""


@dataclass(kw_only=True)
class Cell:
    """A cell and its parts; `close` ends all of them and keeps the grip."""

    controller: CellController
    """Runs the sequences."""
    realtime: bool
    """Whether time passes by itself. In a simulated cell it passes while a caller waits, or follows
    real time after `follow`."""
    simulated: SimulatedCell | None
    """The simulated cell, if there is one in this process."""
    axes: Axes | None
    """The axes of its positioner; None if something else moves the object."""
    _recorder: Recorder | None
    _retention: Retention | None
    _closing: ExitStack
    _pace: Pace | None = None

    def follow(self, real: Clock, speed: float) -> float | None:
        """Let virtual time follow a real clock, at ``speed`` virtual seconds per real second.

        Returns the real period in s for further calls of `idle`; None for a ``speed`` of 0, with
        which time stands still between two commands.
        """
        if self._pace is not None:
            self._pace.end()
        self._pace = None
        if self.simulated is not None and speed > 0.0:
            self._pace = Pace(self.simulated.clock, real, speed=speed)
        return None if self._pace is None else _IDLE_STEP_S

    def idle(self) -> None:
        """Supervise the cell while no job runs; advance the paced clock to now."""
        life = self.controller.life
        if self._recorder is not None:
            self._recorder.check()
        if self.simulated is None or self._pace is None:
            life.tick()
            return
        clock = self.simulated.clock
        end_s = clock.monotonic() + self._pace.lag_s()
        while (left_s := end_s - clock.monotonic()) > 0.0:
            # The time first: it passes even if the supervision raises.
            clock.sleep(min(left_s, life.hand.period_s if life.holding else _IDLE_STEP_S))
            life.tick()

    @property
    def recording_path(self) -> Path | None:
        """The recording, if one is made."""
        return None if self._recorder is None else self._recorder.path

    @property
    def recording_fault(self) -> str | None:
        """Why the recording has stopped; None while it is written, or without a recording."""
        fault = None if self._recorder is None else self._recorder.fault
        return None if fault is None else str(fault)

    @property
    def recording_problem(self) -> str:
        """What threatens the recordings as text for the operator, e.g. little space; or empty."""
        return "" if self._retention is None else self._retention.problem

    def check_recording(self) -> None:
        """Raise RecordingError if the recording has stopped."""
        if fault := self.recording_fault:
            raise RecordingError(fault)

    def health(self) -> dict[str, Any]:
        """Return the counters of both links, the loop and faults."""
        statistics, life = self.controller.hand.statistics, self.controller.life
        return counters(statistics) | {
            "recording": self.recording_fault,
            "faults": {str(number): n for number, n in tuple(life.faults.items())},
        }

    def close(self) -> None:
        """End everything; a held part stays held. A second call does nothing."""
        self._closing.close()


def build_cell(
    config: CellConfig,
    *,
    folder: Path | None = None,
    mover: Mover | None = None,
    places: CarryCallback | None = None,
    ask: Callable[[str], str] | None = None,
    simulated: SimulatedCell | None = None,
    partial: bool = False,
    note: Callable[[str], None] = lambda _text: None,
) -> Cell:
    """Open the buses of a config and build the cell; nothing moves yet.

    Parameters
    ----------
    config
        The cell.
    folder
        Folder of the recording; None: no recording.
    mover
        Moves for a positioner of kind ``callback``.
    places
        Brings kept parts to their places, instead of the positioner.
    ask
        Asks the operator for a positioner of kind ``operator``.
    simulated
        An existing simulated cell that outlives this one; by default a new one.
    partial
        Whether one line of the hand may be missing, for diagnosis and release; see `Hand.missing`.
    note
        Gets messages for the operator, e.g. that the recording has stopped, from any thread.

    Raises
    ------
    ConfigError
        If an argument for the positioner's kind is missing.
    gripper.errors.PortLost, tactile.errors.LinkFault, cell.errors.PositionerError
        If a port, bus or socket cannot be opened.
    """
    with ExitStack() as undo:
        clock: Clock = time
        if config.simulated and simulated is None:
            simulated = simulation_of(config)
            undo.callback(simulated.close)
        if simulated is not None:
            if not config.simulated:
                raise ConfigError(f"{config.name} has real ports and cannot use a simulated cell")
            clock = simulated.clock
        positioner = _positioner(config, simulated, mover, ask, undo, phase=lambda: hand.phase)
        axes = positioner.axes if isinstance(positioner, AxesPositioner) else None
        if places is not None:
            positioner = HostPlaces(positioner, places)
        hand = _hand(config, simulated, partial=partial)
        undo.callback(hand.close)
        recorder = None
        if folder is not None:
            recorder = Recorder(
                folder / "recording.mcap",
                clock,
                pads=pad_array(hand.layout),
                metadata={"cell": config.name, "config": config.model_dump_json()},
                vital=config.recording.when_lost == "hold",
                background=simulated is None,
                note=note,
            )
            undo.callback(recorder.close)
            for text in hand.notes:
                Journal(recorder).note("note", text)
        controller = CellController(
            config,
            hand,
            positioner,
            clock=clock,
            recorder=recorder,
            zeros=stored_zeros(config, state_folder(config, folder)),
        )
        retention = None
        if recorder is not None and folder is not None:
            keep_gb = config.recording.keep_gb
            retention = Retention(
                recorder,
                folder.parent,
                keep_bytes=None if keep_gb is None else 1e9 * keep_gb,
                note=note,
            )
            retention.start()
            undo.callback(retention.close)
        undo.callback(controller.shutdown)
        return Cell(
            controller=controller,
            realtime=simulated is None,
            simulated=simulated,
            axes=axes,
            _recorder=recorder,
            _retention=retention,
            _closing=undo.pop_all(),
        )


def state_folder(config: CellConfig, folder: Path | None) -> Path | None:
    """Return the folder of self-zero and history: for a real cell that of its next program.

    A simulated cell saves them beside its recordings, or not at all without recordings.
    """
    if not config.simulated:
        return Path(config.recording.directory)
    return None if folder is None else folder.parent


def _hand(config: CellConfig, simulated: SimulatedCell | None, *, partial: bool) -> Hand:
    if simulated is None:
        if config.loop.own_process:
            return HandProcess(config, partial=partial)
        return open_hand(config, notes=(SHARED_PROCESS,), partial=partial)
    lines = HandConnections(
        lambda: open_servo_port(simulated),
        lambda: open_can_bus(simulated),
        stream=simulated.servo_port,
        can_bus=simulated.can_bus,
        open_boards=[
            functools.partial(simulated.open_board, n) for n in range(len(simulated.board_streams))
        ],
    )
    return LocalHand(config, lines, clock=simulated.clock)


def _positioner(
    config: CellConfig,
    simulated: SimulatedCell | None,
    mover: Mover | None,
    ask: Callable[[str], str] | None,
    undo: ExitStack,
    *,
    phase: Callable[[], GripperPhase],
) -> Positioner:
    """Return the positioner of the config; mypy refuses a kind without a case here."""
    placer: ObjectPlacer | None = None
    if config.positioner.socket:
        placer = SocketPlacer(config.positioner.socket)
    elif simulated is not None:
        placer = InProcessPlacer(simulated)
    match config.positioner.kind:
        case "callback":
            if mover is None:
                raise ConfigError(
                    "positioner.kind is callback: the host program must pass its mover"
                )
            simulator = None if placer is None else SimulatedPositioner(placer)
            return CallbackPositioner(mover, simulator)
        case "operator":
            if ask is None:
                raise ConfigError(
                    "positioner.kind is operator, but this program has no terminal to ask at: "
                    "choose callback or axes"
                )
            return OperatorPositioner(ask)
        case "simulated":
            assert placer is not None  # the config has checked it
            return SimulatedPositioner(placer)
        case "axes":
            return _axes(config, simulated, placer, ask, undo, phase=phase)
        case kind:
            assert_never(kind)


def _axes(
    config: CellConfig,
    simulated: SimulatedCell | None,
    placer: ObjectPlacer | None,
    ask: Callable[[str], str] | None,
    undo: ExitStack,
    *,
    phase: Callable[[], GripperPhase],
) -> AxesPositioner:
    """Return the positioner with axes; simulator, person or host bring the objects."""
    section, period_s = config.positioner, 1.0 / config.gripper.loop_rate_hz
    clock: Clock = time if simulated is None else simulated.clock
    watch, axes = Watch(clock, period_s), []
    if section.drives:
        bus: CanBus
        if simulated is not None and simulated.axes_can_bus is not None:
            bus = simulated.axes_can_bus
        else:
            bus = drive_bus(config)
            undo.callback(close_bus, bus)
        loss_s = 1e-3 * section.can.heartbeat_loss_ms
        axes += drive_axes(section.drives, bus, watch, loss_s=loss_s)
    for axis in section.axes:
        if isinstance(axis, ServoAxisConfig):
            stream: ByteStream
            if simulated is not None:
                stream = simulated.axes_streams[axis.moves]
            else:
                stream = SerialStream(axis.port, axis.baud_rate)
                undo.callback(stream.close)
            axes.append(servo_axis(axis, stream, watch))
    patient = PatientCaller(clock, period_s)

    def bring(label: str | None, supervise: Supervise) -> None:
        if placer is not None:
            if label is not None:
                placer.place(label, Pose())
        elif ask is not None:
            operator = OperatorPositioner(ask)
            patient.call(lambda: operator.present(label), supervise)

    moved = tuple(axis.moves for axis in section.axes)
    return AxesPositioner(axes=Axes(axes, watch), moved=moved, bring=bring, phase=phase)


def drive_bus(config: CellConfig) -> CanBus:
    """Open the bus of the drives.

    The control unit's own is shared on SocketCAN, where the system lets two programs use it.
    """
    can, own = config.positioner.can, config.tactile
    return open_bus(
        can.interface,
        can.channel,
        bitrate=can.bitrate,
        shared=(can.interface, can.channel) == (own.interface, own.channel),
        nodes=[axis.node_id for axis in config.positioner.drives],
    )
