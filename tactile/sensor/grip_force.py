"""Force on both fingers as samples for a force loop."""

from collections import deque
from collections.abc import Callable, Sequence
from math import inf, sqrt
from operator import mul
from typing import Any, Generic, TypeVar

from tactile.sensor.force_check import ForceCentres
from tactile.sensor.sensor import TactileReading, TactileSensor
from tactile.source import ForceMessage, ScanStatus, TactileFrame, mean_centre_taxels

_MESSAGE_S = 0.0015
"""Time in s from a scan to the reception of its message: half a scan, the wire, the adapter."""
_QUIET_FRAME_N = 0.1
"""Largest noise in N of the grip force in one frame that needs no mean over frames. A mean is older
by a frame, and heavy fingers run too far meanwhile. FlexiTac has 0.04 N, the control unit 0.2 N.
[chosen]"""
_LEAST_FORCE_N = 0.1
"""Least grip force in N for the noise of its centre, so that it stays finite."""
_MOST_FRAMES = 1000
"""Frames kept for `GripForce.take`: 20 s at 50 Hz; older ones are dropped."""
_SATURATED = "a taxel of a gripping pad is saturated"


Sample = TypeVar("Sample")
"""Sample type of the force controller; see `GripForce`."""


class GripForce(Generic[Sample]):
    """Force samples for the force controller; their frames are kept.

    Parameters
    ----------
    sensor
        The sensor; before its start there is no force.
    sample
        Maker of the samples, for example `gripper.ForceSample`, from keyword arguments. These are
        ``t_s``, monotonic time in s; ``force_n``, force on finger 0 and finger 1 in N; ``valid``,
        and ``reason`` if it is not; ``at_least``, whether it is not only because taxels are at full
        scale; ``centre_m``, centre of the force along and across the
        fingers in m, or None; ``centre_noise_m``, its standard deviation; ``lag_s``, age of the
        force at ``t_s``; ``noise_n``, the standard deviation of the mean of both forces. Only
        samples of force messages also have the newest complete frame: ``frame_s``, monotonic time
        of its scan in s, and ``frame_n``, its force on both fingers in N.
    """

    def __init__(self, sensor: TactileSensor, sample: Callable[..., Sample]) -> None:
        self._sensor = sensor
        self._make = sample
        self._new = deque[TactileFrame](maxlen=_MOST_FRAMES)
        self._centres = ForceCentres(sensor.layout)
        pad = sensor.layout.pads[sensor.layout.gripping_pads[0]]
        self._pitch_m = pad.pitch_x_m, pad.pitch_y_m
        self._sample: Sample | None = None
        self._sample_s = -inf

    def latest_force(self) -> Sample | None:
        """Process arrived messages and return the newest sample; does not wait.

        It is the mean of the force messages since the last call, or from the newest frame if the
        unit sends none. Raises as `TactileSensor.poll`.
        """
        if not self._sensor.running:
            return None
        self._new.extend(reading.frame for reading in self._sensor.poll())
        messages = self._sensor.take_forces()
        reading = self._sensor.latest
        zero = self._sensor.tare_result
        if reading is None or (zero is not None and reading.t_s <= zero.t_s):
            # A measurement with an earlier zero is not valid for this one.
            return None
        if not self._sensor.has_forces:
            if reading.t_s > self._sample_s:
                self._sample, self._sample_s = self._from_frame(reading), reading.t_s
        elif messages:
            self._sample, self._sample_s = self._from_messages(messages, reading), messages[-1].t_s
        return self._sample

    def _from_frame(self, reading: TactileReading) -> Sample:
        left, right = reading.finger_force_n
        frame, noise_n = reading.frame, self._sensor.scan_noise_n
        alone: dict[str, Any] = {}
        if noise_n <= _QUIET_FRAME_N:
            lag_s = frame.t_s - frame.scanned_s
            alone = {"force_n": reading.scan_force_n, "lag_s": lag_s, "noise_n": noise_n}
        return self._make(
            **{"force_n": (left, right), **alone},
            t_s=frame.t_s,
            valid=reading.ok,
            at_least=reading.at_least,
            reason=reading.reason,
            centre_m=self._in_m(self._centres.of(reading.force_n)),
            # A mean of frames shares them with the next ones: they show no less noise than one.
            centre_noise_m=self._noise_m(reading, 0.5 * (left + right)),
        )

    def _from_messages(self, messages: Sequence[ForceMessage], reading: TactileReading) -> Sample:
        n, newest = len(messages), messages[-1]
        objections = [text for message in messages if (text := _objection(message.status))]
        reason = reading.reason or next(iter(objections), "")
        at_least = (reading.ok or reading.at_least) and all(
            text == _SATURATED for text in objections
        )
        first_n = sum(message.force_n[0] for message in messages) / n
        second_n = sum(message.force_n[1] for message in messages) / n
        return self._make(
            t_s=newest.t_s,
            force_n=(first_n, second_n),
            valid=not reason,
            at_least=bool(reason) and at_least,
            reason=reason,
            centre_m=self._in_m(mean_centre_taxels(messages)),
            centre_noise_m=self._noise_m(reading, 0.5 * (first_n + second_n)) / sqrt(n),
            lag_s=_MESSAGE_S + newest.t_s - sum(message.t_s for message in messages) / n,
            noise_n=self._sensor.scan_noise_n / sqrt(n),
            frame_s=reading.frame.scanned_s,
            frame_n=reading.scan_force_n,
        )

    def _in_m(self, centre: tuple[float, float] | None) -> tuple[float, float] | None:
        """Return a centre in m that is in pitches of the taxels."""
        return centre and (centre[0] * self._pitch_m[0], centre[1] * self._pitch_m[1])

    def _noise_m(self, reading: TactileReading, grip_n: float) -> float:
        """Return the larger noise of the centre's coordinates in m at a grip force in N.

        It is that of a frame, whose force may be another one.
        """
        noise_m: float = max(map(mul, reading.centre_noise_taxels, self._pitch_m))
        frame_n = max(0.5 * sum(reading.scan_force_n), _LEAST_FORCE_N)
        return noise_m * frame_n / max(grip_n, _LEAST_FORCE_N)

    def take(self) -> list[TactileFrame]:
        """Return the frames since the last call, oldest first."""
        taken = list(self._new)
        self._new.clear()
        return taken


def _objection(status: ScanStatus) -> str:
    """Return why the forces of a message with this status are not valid, empty if they are."""
    if status == ScanStatus.ZEROED:
        return ""
    if not status & ScanStatus.ZEROED:
        return "the control unit has no table or zero for its force messages"
    if status & ScanStatus.CONVERTER_FAULT:
        return "the unit's converter failed its self-test"
    return _SATURATED if status & ScanStatus.SATURATED else ""
