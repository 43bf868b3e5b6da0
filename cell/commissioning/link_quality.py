"""Quality of both lines for a minute, at the rate of the force loop: latency, losses, overruns."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from cell.checks.findings import Notes
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step
from cell.commissioning.unit import unit_sensor
from gripper.dynamixel.control_table import PRESENT_BLOCK
from gripper.dynamixel.latency import check_link
from gripper.dynamixel.transactions import BusStatistics
from gripper.errors import BusCorrupt, BusTimeout
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


def check_lines(
    bench: Bench, dialog: Dialog, notes: Notes, *, duration_s: float = DURATION_S
) -> None:
    """Read the servos and the pads at the rate of the force loop for a minute.

    Late and lost messages are counted. Move cables and plugs by hand meanwhile to find loose ones.
    Nothing moves by itself.
    """
    gripper, tactile, clock = bench.gripper(), bench.tactile(), bench.clock
    ids = [servo.id for servo in gripper.servos]
    period_s = 1.0 / gripper.loop_rate_hz
    dialog.say(f"Both lines are watched for {duration_s:.0f} s. Move each cable a little.")
    answer_s, messages_s, overruns = list[float](), list[float](), 0
    periods = round(duration_s / period_s)
    with unit_sensor(bench, patient=False) as sensor, bench.servo_bus() as bus:
        check_link(bus, ids, period_s)
        sensor.read(timeout_s=1.0)
        sensor.take_forces()
        due_s = clock.monotonic()
        for number in range(periods):
            asked_s = clock.monotonic()
            with suppress(BusTimeout, BusCorrupt):
                bus.sync_read(ids, PRESENT_BLOCK)
                answer_s.append(clock.monotonic() - asked_s)
            sensor.poll()
            messages_s += [message.t_s for message in sensor.take_forces()]
            if number % round(gripper.loop_rate_hz) == 0:
                dialog.live("lines", f"{number * period_s:.0f} of {duration_s:.0f} s")
            due_s += period_s
            overruns += (now_s := clock.monotonic()) > due_s
            due_s = max(due_s, now_s)
            clock.sleep(due_s - now_s)
    _judge_servos(answer_s, periods - len(answer_s), bus.statistics, period_s, notes)
    force_period_s = 1e-3 * tactile.force_period_ms * tactile.sends_forces
    _judge_pads(np.diff(messages_s).tolist(), sensor.source.statistics, force_period_s, notes)
    notes.fact(
        f"Loop: {overruns} of {periods} periods of {1e3 * period_s:g} ms took too long, without "
        "the real-time priority of the cell's loop."
    )
    if overruns > _OVERRUN_SHARE * periods:
        notes.warn(
            "This machine is too busy for the force loop: end other programs, and grant the loop "
            "its real-time priority (`ulimit -r`, limits.conf: rtprio)."
        )


LINK_QUALITY = Step(check_lines, "link_quality", "Quality of the lines", needs=("servos", "unit"))


def _judge_servos(
    answer_s: list[float], lost: int, bus: BusStatistics, period_s: float, notes: Notes
) -> None:
    """Judge the counts of the servos' line: one question in each period."""
    periods = lost + len(answer_s)
    middle_ms, high_ms, worst_ms = notes.values["answer_ms"] = _quantiles_ms(answer_s)
    notes.fact(
        f"Servos: {periods} questions, answers after {middle_ms:.2f} ms (median), "
        f"{high_ms:.2f} ms (99 %), {worst_ms:.2f} ms at most; {lost} without an answer, "
        f"{bus.retries} asked twice, {bus.corrupt} damaged."
    )
    if lost + bus.retries + bus.corrupt > _LOSS_SHARE * periods:
        notes.warn(
            "The servos' line loses answers: check its plugs, the ground between adapter and "
            "servos, and keep its cable away from the motors' supply."
        )
    if middle_ms > _LATE_SHARE * 1e3 * period_s:
        notes.warn(
            f"The servos answer after {middle_ms:.1f} ms, too late for a period of "
            f"{1e3 * period_s:g} ms: set the adapter's latency timer to 1 ms, or a faster rate."
        )


def _judge_pads(
    gap_s: list[float], source: SourceStatistics, force_period_s: float, notes: Notes
) -> None:
    """Judge the counts of the CAN bus."""
    frames, forces = source.frames, source.forces
    lost = frames.lost + frames.torn + frames.corrupt
    _, high_ms, worst_ms = notes.values["force_gap_ms"] = _quantiles_ms(gap_s)
    notes.fact(
        f"Pads: {frames.complete} frames, {lost} lost or damaged; {forces.received} force "
        f"messages, {forces.lost} lost, {high_ms:.1f} ms between two (99 %), {worst_ms:.1f} ms at "
        f"most; {source.malformed} damaged messages, {source.error_frames} error frames."
    )
    n_messages = max(1, frames.complete + forces.received)
    if lost + forces.lost + source.malformed > _LOSS_SHARE * n_messages:
        notes.warn(
            "The CAN bus loses messages: check both terminating resistors (60 Ohm between CAN_H "
            "and CAN_L, switched off), the plugs, and the bus load."
        )
    if source.error_frames:
        notes.warn("The CAN controller reports errors: check termination and cable.")
    if force_period_s and high_ms > _GAP_PERIODS * 1e3 * force_period_s:
        notes.warn(
            f"Force messages come with gaps of {high_ms:.0f} ms: another program or the adapter "
            "delays them."
        )


def _quantiles_ms(values_s: Sequence[float]) -> list[float]:
    """Return median, 99 % quantile and maximum in ms; zeros without any."""
    found = np.quantile(values_s or [0.0], (0.5, 0.99, 1.0))
    return [round(1e3 * float(value), 4) for value in found]
