"""Recorded grasps through the real links: CAN frames and servo packets out, grasps back in."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from cell.config.gripper import GripperConfig, RackPinionConfig, ServoConfig
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_pads, link_settings
from cell.errors import CellError
from cell.learning.progress import Progress
from cell.simulation import largest_aperture_m, simulator_settings
from gripper.gripper import open_gripper
from gripper.settings import HARD_FORCE_CAP_N
from gripper.values.force_sensor import ForceSample
from recognition.grasp import Grasp
from simulator.cell import SimulatedCell
from tactile.sensor.opening import open_sensor
from tactile.source import TactileFrame

_SHORTEST_PERIOD_S = 0.012
_WAIT_S = 0.001
_BURST_SHARE = 0.9
_OPENING_PER_RADIUS = 4.0
"""Opening at which the pinion has turned by 1 rad in either direction: well within one turn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayResult:
    """Results of a replay."""

    n_grasps: int
    """Grasps replayed."""
    frames_sent: int
    frames_received: int
    """Number of tactile frames sent to the simulated control unit and received."""
    frames_equal: bool
    """Whether each received frame equals the sent one, bit for bit."""
    difference: str | None
    """The first difference."""
    aperture_error_mm: float
    """Largest difference of a received opening in mm: the servos report whole pulses."""
    seconds: float
    """Duration in s."""


def replay_grasps(
    grasps: Sequence[Grasp],
    config: CellConfig | None = None,
    *,
    limit: int | None,
    progress: Progress,
) -> ReplayResult:
    """Send recorded grasps through the links, and compare what comes back.

    Raises CellError if the grasps cannot be played.

    Parameters
    ----------
    config
        Servos and control unit to play with; by default rack-driven fingers that open far enough.
    limit
        Most grasps to replay, spread evenly; None: all.
    """
    started_s = time.monotonic()
    sent = tuple(grasps)
    if limit is not None and limit < len(sent):
        sent = tuple(sent[i] for i in np.linspace(0, len(sent) - 1, limit).round().astype(int))
    received = []
    with _Rig(config or _wide_config(sent), sent) as rig:
        for number, grasp in enumerate(sent):
            received.append(rig.play(number, grasp))
            progress("replay", number + 1, len(sent))
    difference = _first_difference(sent, received)
    return ReplayResult(
        n_grasps=len(sent),
        frames_sent=sum(grasp.n_frames for grasp in sent),
        frames_received=sum(grasp.n_frames for grasp in received),
        frames_equal=not difference,
        difference=difference or None,
        aperture_error_mm=round(1e3 * _aperture_error_m(sent, received), 4),
        seconds=round(time.monotonic() - started_s, 2),
    )


class _NoForce:
    """A force sensor without values, for a gripper that is only read."""

    def latest_force(self) -> ForceSample | None:
        return None


class _Rig:
    """Simulated control unit and servos that play grasps, and the drivers that receive them."""

    def __init__(self, config: CellConfig, grasps: Sequence[Grasp]) -> None:
        layout = layout_from_pads(grasps[0].pads)
        with ExitStack() as undo:
            self._cell = SimulatedCell(simulator_settings(config, layout=layout, grasps=grasps))
            undo.callback(self._cell.close)
            self._period_s = max(_frame_period_s(grasps), _SHORTEST_PERIOD_S)
            self._source = open_sensor(
                self._cell.can_bus,
                layout,
                node_id=config.tactile.node_id,
                link=replace(
                    link_settings(config.tactile),
                    sync_period_s=self._period_s,
                    force_period_s=0.0,
                    mounts=(),
                ),
            ).source
            self._gripper = undo.enter_context(
                open_gripper(
                    self._cell.servo_port,
                    config.gripper_settings,
                    config.linkage,
                    baud_rate=config.gripper.baud_rate,
                    force_sensor=_NoForce(),
                )
            )
            self._source.start()
            undo.callback(self._source.stop)
            self._closing = undo.pop_all()
        while not self._source.poll().frames:
            self._cell.clock.sleep(_WAIT_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._closing.close()

    def play(self, number: int, grasp: Grasp) -> Grasp:
        """Send one grasp and return what was received.

        Call it right after a burst, so that the next SYNC latches the first frame.
        """
        self._cell.play(number)
        frames: list[TactileFrame] = []
        apertures_m: list[float] = []
        last_latched_s: float | None = None
        while True:
            now_s = self._cell.clock.monotonic()
            if last_latched_s is None and self._cell.recorded.remaining == 0:
                last_latched_s = now_s
            new = self._source.poll().frames
            if new:
                opening_m = self._gripper.read_feedback().aperture_m
                frames += new
                apertures_m += [opening_m] * len(new)
            if last_latched_s is not None and (
                new or now_s - last_latched_s > _BURST_SHARE * self._period_s
            ):
                break
            self._cell.clock.sleep(_WAIT_S)
        if not frames:
            raise CellError(f"grasp {number} was played, but no whole frame was received")
        n, all_came = len(frames), len(frames) == grasp.n_frames
        known = np.isfinite(grasp.aperture_m) if all_came else np.ones(n, dtype=bool)
        return Grasp(
            pads=grasp.pads,
            counts=np.stack([frame.counts for frame in frames]),
            t_s=np.array([frame.t_s for frame in frames]) - frames[0].t_s,
            aperture_m=np.where(known, apertures_m, np.nan),
            force_n=grasp.force_n if all_came else np.full(n, np.nan),
            label=grasp.label,
            shape=grasp.shape,
            source=grasp.source,
            start_ms=grasp.start_ms,
            command=grasp.command,
        )


def _wide_config(grasps: Sequence[Grasp]) -> CellConfig:
    """Return a cell with rack-driven fingers that open as far as the records do."""
    opening_mm = max(largest_aperture_m(grasps) * 1e3 + 5.0, 30.0)
    return CellConfig(
        name="replay",
        gripper=GripperConfig(
            servos=(ServoConfig(id=1), ServoConfig(id=2)),
            linkage=RackPinionConfig(
                kind="rack_pinion",
                pinion_radius_mm=opening_mm / _OPENING_PER_RADIUS,
                offset_mm=0.25 * opening_mm,
            ),
            aperture_open_mm=opening_mm,
            contact_timeout_s=60.0,
            force_max_n=HARD_FORCE_CAP_N,
        ),
    )


def _frame_period_s(grasps: Sequence[Grasp]) -> float:
    """Return the median time between two recorded frames in s."""
    steps_s = np.concatenate([np.diff(grasp.t_s) for grasp in grasps])
    known_s = steps_s[np.isfinite(steps_s) & (steps_s > 0.0)]
    return float(np.median(known_s)) if len(known_s) else 0.02


def _first_difference(sent: Sequence[Grasp], received: Sequence[Grasp]) -> str:
    for number, (one, other) in enumerate(zip(sent, received, strict=True)):
        if one.n_frames != other.n_frames:
            return f"grasp {number}: {one.n_frames} frames sent, {other.n_frames} received"
        if not np.array_equal(one.counts, other.counts):
            frame, taxel = np.argwhere(one.counts != other.counts)[0]
            return (
                f"grasp {number}, frame {frame}, taxel {taxel}: sent {one.counts[frame, taxel]}, "
                f"received {other.counts[frame, taxel]}"
            )
    return ""


def _aperture_error_m(sent: Sequence[Grasp], received: Sequence[Grasp]) -> float:
    errors_m = [
        np.nanmax(np.abs(one.aperture_m - other.aperture_m), initial=0.0)
        for one, other in zip(sent, received, strict=True)
        if one.n_frames == other.n_frames and np.isfinite(one.aperture_m).any()
    ]
    return float(max(errors_m, default=0.0))
