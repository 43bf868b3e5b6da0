"""Health of a cell for a display: a level for each of its parts, and the figures behind it.

All limits come from the config; the cell itself acts beyond them.
"""

from typing import Any

from cell.build import Cell
from cell.config.model import CellConfig
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.force.timing import LATE_SHARE, LoopStatistics
from recognition.drift.drift import DriftGrid


def health_values(config: CellConfig, cell: Cell, drift: DriftGrid | None) -> dict[str, Any]:
    """Return level and figures of servos, CAN, loop, drift, self-zero and recording as plain data.

    Levels are ``ok``, ``watch`` (the cell will act soon, or a function is degraded) and ``bad``.
    """
    controller = cell.controller
    statistics = controller.hand.statistics
    return {
        "servos": _servos(config, cell),
        "can": _can(config, cell),
        "loop": _loop(statistics.loop, controller.hand.period_s),
        "drift": _drift(drift),
        "zero": _level(watch=bool(controller.zeroing.note), bad=False)
        | {"text": controller.zeroing.note},
        "recording": _recording(cell, vital=config.recording.when_lost == "hold"),
    }


def _level(*, watch: bool, bad: bool) -> dict[str, Any]:
    return {"level": "bad" if bad else "watch" if watch else "ok"}


def _servos(config: CellConfig, cell: Cell) -> dict[str, Any]:
    """Heat: of the housing by its limit, of the winding by the current that is left."""
    gripper = config.gripper
    cycle, drives = cell.controller.latest.cycle, cell.controller.zeroing.drives
    servos = () if cycle is None else cycle.state.servos
    warmest_c = max((servo.temperature_c for servo in servos), default=0.0)
    lowered = any(servo.limit_a < gripper.current_max_a for servo in servos)
    return _level(watch=lowered, bad=warmest_c > gripper.temperature_max_c) | {
        "temperature_c": [servo.temperature_c for servo in servos],
        "load": [abs(servo.current_a) / gripper.current_max_a for servo in servos],
        "drives": [_drive(drives.get(servo.id)) for servo in gripper.servos],
    }


def _drive(drive: DriveCharacteristic | None) -> dict[str, Any] | None:
    """Return the measured values of a servo; None without a measurement."""
    if drive is None:
        return None
    names = ("breakaway_a", "rising_a_nm", "falling_a_nm", "measured_s")
    return {name: getattr(drive, name) for name in names}


def _can(config: CellConfig, cell: Cell) -> dict[str, Any] | None:
    """Lost frames among the newest: one gives ``watch``, the share of the limit is a fault."""
    source = cell.controller.hand.statistics.source
    frame = cell.controller.latest.frame
    if frame is None:
        return None
    lost = source.recent_loss_rate
    return _level(watch=lost > 0.0, bad=lost > config.tactile.loss_max_share) | {
        "frames": source.frames.complete,
        "lost": source.frames.lost,
        "age_s": max(0.0, cell.controller.clock.monotonic() - frame.t_s),
    }


def _loop(loop: LoopStatistics, period_s: float) -> dict[str, Any]:
    """Lateness of the latest 1 % of the periods: above the limit for late, or a whole period."""
    p99_s = loop.lateness.p99_s
    level = _level(watch=p99_s > LATE_SHARE * period_s, bad=p99_s > period_s)
    return level | {"periods": loop.cycles, "late": loop.late, "p99_ms": 1e3 * p99_s}


def _drift(grid: DriftGrid | None) -> dict[str, Any] | None:
    if grid is None:
        return None
    drift = grid.drift
    return _level(watch=grid.likely, bad=False) | {
        "gain": drift.gain,
        "opening_mm": 1e3 * drift.aperture_offset_m,
    }


def _recording(cell: Cell, *, vital: bool) -> dict[str, Any]:
    path, fault = cell.recording_path, cell.recording_fault
    problem = fault or cell.recording_problem
    return _level(watch=bool(problem), bad=vital and fault is not None) | {
        "path": None if path is None else str(path),
        "text": problem,
    }
