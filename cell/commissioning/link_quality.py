"""Quality of both lines for a minute, at the rate of the force loop: latency, losses, overruns."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cell.checks.findings import Finding
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step
from cell.commissioning.figures import curves
from cell.commissioning.unit import unit_sensor
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_BLOCK
from gripper.dynamixel.latency import check_link
from gripper.dynamixel.transactions import BusStatistics
from gripper.errors import BusCorrupt, BusTimeout
from tactile.sensor.sensor import TactileSensor
from tactile.source import SourceStatistics

DURATION_S = 60.0
"""Duration in s of the test of the lines; a loose plug shows only sometimes."""
_LOSS_SHARE = 1e-3
"""Least reported share of lost messages, frames or answers: a good bus loses none, and one lost
message in a thousand already costs 6 % of the frames."""
_OVERRUN_SHARE = 1e-3
"""Share of the periods that may take too long here: this program has no real-time priority, unlike
the loop of the cell."""
_LATE_SHARE = 0.8
"""Share of the period that answers may take; also the limit of `gripper.dynamixel.latency`."""
_GAP_PERIODS = 4.0
"""Least reported gap between two force messages, in their periods."""
_LIVE_S = 1.0
"""Time in s between two texts on the screen, and between two points of the picture."""


@dataclass(slots=True)
class LinkQuality:
    """Measurements of both lines, second by second."""

    answer_s: list[float] = field(default_factory=list)
    """Time in s from the request to all servos to their answers, of each period; NaN if missing."""
    force_gap_s: list[float] = field(default_factory=list)
    """Time in s between two force messages."""
    second_s: list[float] = field(default_factory=list)
    worst_answer_ms: list[float] = field(default_factory=list)
    worst_force_ms: list[float] = field(default_factory=list)
    """End of each second in s, and in it the longest answer and gap between force messages, ms."""
    periods: int = 0
    """Periods of the force loop."""
    overruns: int = 0
    """Periods whose work took longer than the period."""


def watch_lines(
    sensor: TactileSensor | None,
    bus: ServoBus,
    ids: Sequence[int],
    clock: Clock,
    *,
    period_s: float,
    duration_s: float,
    dialog: Dialog,
) -> LinkQuality:
    """Read all servos, and the pads if there are any, once a period; return the quality of both.

    Raises GripperError or TactileError if a line fails permanently.
    """
    quality = LinkQuality()
    began_s = due_s = clock.monotonic()
    end_s, shown_s = began_s + duration_s, began_s
    force_s = float("nan")
    first_answer = first_gap = 0
    while due_s < end_s - 0.5 * period_s:
        asked_s = clock.monotonic()
        try:
            bus.sync_read(ids, PRESENT_BLOCK)
            quality.answer_s.append(clock.monotonic() - asked_s)
        except (BusTimeout, BusCorrupt):
            quality.answer_s.append(float("nan"))
        if sensor is not None:
            sensor.poll()
        for message in () if sensor is None else sensor.take_forces():
            quality.force_gap_s.append(message.t_s - force_s)
            force_s = message.t_s
        quality.periods += 1
        due_s += period_s
        now_s = clock.monotonic()
        if now_s > due_s:
            quality.overruns += 1
            due_s = now_s
        if now_s - shown_s >= _LIVE_S:
            shown_s = now_s
            answers = _known(quality.answer_s[first_answer:])
            gaps = _known(quality.force_gap_s[first_gap:])
            first_answer, first_gap = len(quality.answer_s), len(quality.force_gap_s)
            quality.second_s.append(now_s - began_s)
            quality.worst_answer_ms.append(1e3 * max(answers, default=float("nan")))
            quality.worst_force_ms.append(1e3 * max(gaps, default=float("nan")))
            dialog.live("lines", f"{now_s - began_s:.0f} of {duration_s:.0f} s")
        clock.sleep(max(0.0, due_s - clock.monotonic()))
    return quality


def _known(values: Sequence[float]) -> list[float]:
    return [value for value in values if np.isfinite(value)]


@dataclass(frozen=True, slots=True)
class LinkQualityStep(Step):
    """Watches both lines at the rate of the force loop."""

    key = "link_quality"
    title = "Quality of the lines"
    purpose = (
        "Reads the servos and the pads at the rate of the force loop for a minute, and counts late "
        "and lost messages. Move cables and plugs by hand meanwhile to find loose ones. Nothing "
        "moves by itself."
    )
    needs = ("servos", "unit")
    duration_s: float = DURATION_S
    """Duration of the test in s."""

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        """Watch both lines, and judge the counts."""
        gripper = bench.gripper()
        ids = [servo.id for servo in gripper.servos]
        period_s = 1.0 / gripper.loop_rate_hz
        dialog.say(f"Both lines are watched for {self.duration_s:.0f} s. Move each cable a little.")
        with contextlib.ExitStack() as undo:
            sensor = None
            if not bench.gripper_alone:
                sensor = undo.enter_context(unit_sensor(bench, patient=False))
            bus = undo.enter_context(bench.servo_bus())
            check_link(bus, ids, period_s)
            before = bus.statistics
            if sensor is not None:
                sensor.read(timeout_s=1.0)
                sensor.take_forces()
            quality = watch_lines(
                sensor,
                bus,
                ids,
                bench.clock,
                period_s=period_s,
                duration_s=self.duration_s,
                dialog=dialog,
            )
            source = None if sensor is None else sensor.source.statistics
            after = bus.statistics
        advice = _judge_servos(quality, before, after, period_s, notes)
        if source is not None:
            tactile = bench.tactile()
            force_period_s = 1e-3 * tactile.force_period_ms * tactile.sends_forces
            advice += _judge_pads(quality, source, force_period_s, notes)
        notes.fact(
            f"Loop: {quality.overruns} of {quality.periods} periods of {1e3 * period_s:g} ms took "
            "too long, without the real-time priority of the cell's loop."
        )
        if quality.overruns > _OVERRUN_SHARE * quality.periods:
            advice.append(
                "This machine is too busy for the force loop: end other programs, and grant the "
                "loop its real-time priority (`ulimit -r`, limits.conf: rtprio)."
            )
        for line in advice:
            notes.warn(line)
        notes.values |= {"overruns": quality.overruns, "periods": quality.periods}
        notes.figures["lines"] = curves(
            "Longest wait of each second",
            quality.second_s,
            {
                "answer of the servos": quality.worst_answer_ms,
                "gap between force messages": quality.worst_force_ms,
            },
            x_label="time / s",
            y_label="wait / ms",
            limits={"period of the force loop": 1e3 * period_s},
        )


def _judge_servos(
    quality: LinkQuality,
    before: BusStatistics,
    after: BusStatistics,
    period_s: float,
    notes: Finding,
) -> list[str]:
    """Note the counts of the servos' line; return advice."""
    asked, answers = len(quality.answer_s), _known(quality.answer_s)
    lost, retries = asked - len(answers), after.retries - before.retries
    damaged = after.corrupt - before.corrupt
    middle_s, high_s, worst_s = _quantiles(answers)
    notes.fact(
        f"Servos: {asked} questions, answers after {1e3 * middle_s:.2f} ms (median), "
        f"{1e3 * high_s:.2f} ms (99 %), {1e3 * worst_s:.2f} ms at most; {lost} without an answer, "
        f"{retries} asked twice, {damaged} damaged."
    )
    notes.values |= {
        "answer_ms": [round(1e3 * value, 4) for value in (middle_s, high_s, worst_s)],
        "lost_answers": lost,
        "retries": retries,
    }
    advice = []
    if lost + retries + damaged > _LOSS_SHARE * asked:
        advice.append(
            "The servos' line loses answers: check its plugs, the ground between adapter and "
            "servos, and keep its cable away from the motors' supply."
        )
    if middle_s > _LATE_SHARE * period_s:
        advice.append(
            f"The servos answer after {1e3 * middle_s:.1f} ms, too late for a period of "
            f"{1e3 * period_s:g} ms: set the latency timer of the adapter to 1 ms or raise the "
            "baud rate."
        )
    return advice


def _judge_pads(
    quality: LinkQuality, source: SourceStatistics, force_period_s: float, notes: Finding
) -> list[str]:
    """Note the counts of the CAN bus; return advice."""
    frames, forces = source.frames, source.forces
    lost = frames.lost + frames.torn + frames.corrupt
    _, high_s, worst_s = _quantiles(_known(quality.force_gap_s))
    notes.fact(
        f"Pads: {frames.complete} frames, {lost} lost or damaged; {forces.received} force "
        f"messages, {forces.lost} lost, {1e3 * high_s:.1f} ms between two (99 %), "
        f"{1e3 * worst_s:.1f} ms at most; {source.malformed} damaged messages, "
        f"{source.error_frames} error frames."
    )
    notes.values |= {
        "force_gap_ms": [round(1e3 * value, 3) for value in (high_s, worst_s)],
        "frames": frames.complete,
        "lost_frames": lost,
        "forces": forces.received,
        "lost_forces": forces.lost,
    }
    advice = []
    n_messages = max(1, frames.complete + forces.received)
    if lost + forces.lost + source.malformed > _LOSS_SHARE * n_messages:
        advice.append(
            "The CAN bus loses messages: check both terminating resistors (60 Ohm between CAN_H "
            "and CAN_L, switched off), the plugs, and the bus load."
        )
    if source.error_frames:
        advice.append("The CAN controller reports errors: check termination and cable.")
    if force_period_s and high_s > _GAP_PERIODS * force_period_s:
        advice.append(
            f"Force messages come with gaps of {1e3 * high_s:.0f} ms: another program or the "
            "adapter delays them."
        )
    return advice


def _quantiles(values_s: Sequence[float]) -> tuple[float, float, float]:
    """Return median, 99 % quantile and maximum; zeros without any."""
    if not values_s:
        return 0.0, 0.0, 0.0
    found: NDArray[np.float64] = np.quantile(values_s, (0.5, 0.99, 1.0))
    return float(found[0]), float(found[1]), float(found[2])
