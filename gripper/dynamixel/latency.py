"""Round trips to the servos: measured at each start, refused if too slow for the loop.

A USB adapter with a latency of 16 ms, a slow baud rate or a busy machine would otherwise cause lost
answers during a grasp.
"""

from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING

from gripper.errors import BusCorrupt, BusTimeout, LinkTooSlow

if TYPE_CHECKING:
    from gripper.dynamixel.bus import ServoBus

_ROUNDS = 20
"""Pings of each servo: 40 round trips with two servos, in less than 0.1 s on a good link."""
LEAST_RATE_HZ = 100.0
"""Least rate of the loop in Hz. In random configs with 50 Hz pads met with up to 1.6 times the
cap of the force, with 100 Hz and more with at most 0.81 (``benchmarks force_cap``)."""
_WORK_SHARE = 0.8
"""Share of a period that reading and writing may take; the rest is for control and lateness."""
_SLOW_SHARE = 0.25
"""Share of the answers that may be lost or take longer than the longest time-out."""
_LOST_S = 1.0
"""Time in s that a lost answer counts as: longer than any period."""
_HIGH_QUANTILE = 0.9
"""Quantile of the round trips that the time-outs are fitted to."""
_ALLOWANCE_REACH = 2.0
"""Time-out for adapter and operating system, in multiples of that quantile."""
_ALLOWANCE_SHARE = 0.4
"""Longest such time-out as a share of the period: request and repetition fit into it."""
# Bytes on the wire: an instruction packet has 10 bytes around its parameters, a status packet 11.
_PING_BYTES = 10 + 11 + 3
"""Request and answer of a ping."""
_READ_BYTES, _READ_BYTES_ONE = 10 + 4, 1 + 11 + 27
"""Sync read of registers 120 to 146: the request, and for each servo its ID and its answer."""
_WRITE_BYTES, _WRITE_BYTES_ONE = 10 + 4, 1 + 18
"""Sync write of registers 102 to 119: the request, and for each servo its ID and its data."""


def _wire_s(baud_rate: int, n_servos: int) -> float:
    """Return the time in s of the bytes that are read and written in one period."""
    n_bytes = _READ_BYTES + _WRITE_BYTES + n_servos * (_READ_BYTES_ONE + _WRITE_BYTES_ONE)
    return 10.0 * n_bytes / baud_rate


def largest_rate_hz(baud_rate: int, n_servos: int) -> float:
    """Return the rate of the loop in Hz up to which the bytes of a period fit into it."""
    return _WORK_SHARE / _wire_s(baud_rate, n_servos)


def check_link(bus: "ServoBus", ids: Sequence[int], period_s: float) -> float:
    """Fit the time-outs to the measured round trips, and refuse a link that is too slow.

    Returns the median of the round trips in s. Raises LinkTooSlow when the work of a period does
    not fit into it, or too many answers take longer.

    Parameters
    ----------
    bus
        The servos; no command may run.
    """
    trips_s = sorted(_trip_s(bus, servo_id) for _ in range(_ROUNDS) for servo_id in ids)
    typical_s = median(trips_s)
    high_s = trips_s[int(_HIGH_QUANTILE * (len(trips_s) - 1))]
    ping_s = _PING_BYTES * 10.0 / bus.baudrate
    waiting_s, longest_s = max(0.0, typical_s - ping_s), _ALLOWANCE_SHARE * period_s
    slow_share = sum(trip_s > ping_s + longest_s for trip_s in trips_s) / len(trips_s)
    work_s = _wire_s(bus.baudrate, len(ids)) + waiting_s
    if work_s > _WORK_SHARE * period_s:
        rate_hz = int(_WORK_SHARE / work_s)
        lower = f", or lower loop_rate_hz to {rate_hz}" if rate_hz >= LEAST_RATE_HZ else ""
        raise LinkTooSlow(
            f"a servo answers after {typical_s * 1e3:.1f} ms (median); reading and writing all "
            f"servos takes {work_s * 1e3:.1f} ms of a period of {period_s * 1e3:.1f} ms, the "
            f"limit is {_WORK_SHARE * period_s * 1e3:.1f} ms: set the latency timer of the "
            f"USB adapter to 1 ms (/sys/bus/usb-serial/devices/*/latency_timer), raise the baud "
            f"rate{lower}. Nothing has moved"
        )
    if slow_share > _SLOW_SHARE:
        raise LinkTooSlow(
            f"{slow_share:.0%} of {len(trips_s)} answers were lost or took longer than "
            f"{(ping_s + longest_s) * 1e3:.1f} ms, the time that a period of {period_s * 1e3:.1f} "
            f"ms has for one; the longest took {trips_s[-1] * 1e3:.1f} ms, the median is "
            f"{typical_s * 1e3:.1f} ms. This machine is too busy for the loop, or the "
            f"cable is bad: end other programs or lower loop_rate_hz. Nothing has moved"
        )
    fitted_s = min(_ALLOWANCE_REACH * high_s, longest_s)
    bus.port.allowance_s = max(bus.port.least_allowance_s, fitted_s)
    return typical_s


def _trip_s(bus: "ServoBus", servo_id: int) -> float:
    try:
        return bus.round_trip_s(servo_id)
    except (BusTimeout, BusCorrupt):
        return _LOST_S
