"""The tactile sensor: converts the frames of a source to forces on taxels, pads and fingers."""

from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass
from math import inf, sqrt
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile.clock import Clock
from tactile.errors import CalibrationError, ForceContradicted, FrameTimeout, ZeroDrifted
from tactile.layout import TaxelLayout
from tactile.sensor.calibration import Calibration
from tactile.sensor.filters import (
    ActiveTaxels,
    Mask,
    Neighbourhood,
    Values,
    fill_bad,
    typical_noise,
)
from tactile.sensor.force_check import ForceCentres, ForceCheck
from tactile.sensor.quality import QualityWatch
from tactile.sensor.settings import SensorSettings
from tactile.sensor.tare import TareResult, compute_tare, too_many_bad
from tactile.source import (
    ForceMessage,
    FrameSource,
    PadZero,
    ScanStatus,
    SourceIdentity,
    TactileFrame,
)

_Item = TypeVar("_Item")

_MOST_FORCES = 1000
"""Size of the queue of force messages: five seconds at 200 a second; older ones are dropped."""
_GAP_S = 0.1
"""Longest gap between frames in the mean in s; after a longer one the mean starts again."""
_POLL_S = 0.001
"""Pause between two polls during a wait in s."""
_ROUNDING_COUNTS = 12.0**-0.5
"""Standard deviation of the rounding to whole counts."""
_TOUCH_SIGMAS = 5.0
"""A source's threshold of touched taxels, in standard deviations of its mean."""
_BINOMIAL = 16.0
"""Sum of the weights of that mean over 3 x 3 taxels, also at a border."""
_SOURCE_GAIN = 6.0 / _BINOMIAL * sqrt(1.0 / 7.0)
"""Factor of that mean on independent noise: binomial over 3 x 3 taxels, running over 4 scans."""
_TOUCH_SHARE = 0.012
"""Least threshold as a share of the full scale: above the allowed drift of a zero."""
_LEAST_TOUCHED = 9
"""Least number of touched taxels of a pad: one and its neighbours."""
_EDGE = 1.7
"""Number of taxels that the unit sums for each touched one in the frames: it adds the neighbours,
and their noise grows with the load (simulated cell, 1 to 8 N)."""


@dataclass(slots=True, kw_only=True)
class SensorStatistics:
    """Bad taxels of the newest frame, and counts since the start; both are updated."""

    bad_taxels: int = 0
    """Taxels that do not measure; masked and filled from their neighbours."""
    saturated_frames: int = 0
    """Frames with healthy taxels at full scale."""
    void_frames: int = 0
    """Frames after the tare without valid finger forces."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TactileReading:
    """One frame and its forces in newtons. Arrays are read-only."""

    frame: TactileFrame
    """The raw frame."""
    tared_counts: Values
    """(n_taxels,) float64: counts above the zero, averaged over the last frames, bad taxels filled
    from neighbours."""
    force_n: Values
    """(n_taxels,) float64: normal force on each active taxel in N, 0 on the others."""
    finger_force_n: tuple[float, float]
    """Force on the gripping pad of finger 0 and of finger 1 in N."""
    scan_force_n: tuple[float, float]
    """The same of this frame alone, on the taxels that were touched in the last frames."""
    centre_noise_taxels: tuple[float, float]
    """Standard deviation of the centre of the force in this frame, or in a message of its time,
    along and across the fingers in pitches of the taxels; infinite without a force on both pads."""
    active: Mask
    saturated: Mask
    bad: Mask
    """(n_taxels,) bool: touched taxels; taxels at full scale in this frame; taxels that do not
    measure: dead, stuck or constantly at full scale, filled from their neighbours."""
    ok: bool
    """Whether the finger forces may be used for control."""
    at_least: bool
    """Whether they may not only because taxels of a gripping pad are at full scale: the true forces
    are at least these."""
    reason: str
    """Reason if not; empty if ok."""

    @property
    def t_s(self) -> float:
        """Monotonic time of reception in s."""
        return self.frame.t_s


class TactileSensor:
    """The tactile sensor: tares the frames of a source and converts them to forces.

    Parameters
    ----------
    calibration
        Counts to forces; must be for the layout's full scale.
    """

    def __init__(
        self,
        source: FrameSource,
        calibration: Calibration,
        *,
        clock: Clock,
        settings: SensorSettings | None = None,
    ) -> None:
        layout = source.layout
        if calibration.adc_max != layout.adc_max:
            raise CalibrationError(
                f"the calibration is for a full scale of {calibration.adc_max} counts, layout "
                f"{layout.name} has {layout.adc_max}"
            )
        self.source = source
        """Source of frames and force messages."""
        self.line = ExitStack()
        """What `open_sensor` has opened; closed at the end of a ``with``."""
        self.running = False
        """Whether it was started, and not closed since."""
        self.identity: SourceIdentity | None = None
        """Device of the last start, None before the first one."""
        self.layout = layout
        """The taxels."""
        self.calibration = calibration
        """Counts to forces."""
        self._clock = clock
        self._settings = settings or SensorSettings()
        self._per_count_n = calibration.force_n(np.ones(layout.n_taxels))
        self._force_check = ForceCheck()
        self._centres = ForceCentres(layout)
        self._hood = Neighbourhood(layout)
        self._frames = deque[Values](maxlen=self._settings.mean_frames)
        self._quality = QualityWatch(self._hood, self._settings)
        self._reset()

    def _reset(self) -> None:
        self._frames.clear()
        self.tare_result: TareResult | None = None
        """The zero in use, None before the first tare after a start."""
        self._touch: ActiveTaxels | None = None
        self.latest: TactileReading | None = None
        """The newest reading of `poll`, None before; its ``t_s`` gives its age."""
        self.scan_noise_n = inf
        """Standard deviation in N of the grip force of one force message, or of one frame."""
        self._failed: FrameTimeout | ForceContradicted | None = None
        self._new_forces: deque[ForceMessage] = deque(maxlen=_MOST_FORCES)
        self._force_bad: Mask | None = None
        self._pad_noise_n = np.full(self.layout.n_pads, inf)
        self.statistics = SensorStatistics()
        """Counts since the start."""
        self._quality.restart(None)

    def start(self) -> SourceIdentity:
        """Start the source; the zero of an earlier start is discarded."""
        self.running = False
        self._reset()
        self.identity = self.source.start()
        self.running = True
        return self.identity

    def stop(self) -> None:
        """Stop the source; the line stays open for another start."""
        self.running = False
        self.source.stop()

    def __enter__(self) -> Self:
        """Start the sensor, see `start`; an error closes the line."""
        try:
            self.start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        """Stop the source, and close the line if `open_sensor` has opened it."""
        self.stop()
        self.line.close()

    def poll(self) -> tuple[TactileReading, ...]:
        """Return the readings since the last call, oldest first; does not wait.

        Raises the errors of the source, FrameTimeout for frozen samples, and ForceContradicted if
        force messages and frames differ. Later calls raise the same error again.
        """
        if self._failed is not None:
            raise self._failed
        arrived = self.source.poll()
        self._new_forces.extend(arrived.forces)
        self._force_check.messages.extend(arrived.forces)
        try:
            readings = tuple(self._reading(frame) for frame in arrived.frames)
        except (FrameTimeout, ForceContradicted) as fault:
            self._failed = fault
            raise
        if readings:
            self.latest = readings[-1]
            touched = np.maximum(self.layout.on_fingers(self.latest.active), _LEAST_TOUCHED)
            self.scan_noise_n = 0.5 * sqrt(_EDGE * touched @ self._grip_noise_n2)
        return readings

    def take_forces(self) -> tuple[ForceMessage, ...]:
        """Return the force messages of the polls since the last call, oldest first."""
        forces = tuple(self._new_forces)
        self._new_forces.clear()
        return forces

    @property
    def has_forces(self) -> bool:
        """Whether the force messages are valid: the unit sums with the present zero.

        If a taxel has failed since, frames give the force until the pads are free.
        """
        return self._force_bad is not None and bool((self._force_bad == self._quality.bad).all())

    def read(self, timeout_s: float = 0.5) -> TactileReading:
        """Wait for a reading newer than this call; FrameTimeout after ``timeout_s``."""
        self.poll()
        return self._waited(self.poll, timeout_s, f"no frame within {timeout_s:g} s")[-1]

    def refresh(self) -> None:
        """Wait until the mean has only new frames. Raises FrameTimeout as `read`."""
        for _ in range(self._settings.mean_frames):
            self.read()

    def tare(self, n_frames: int = 100, timeout_s: float = 1.0) -> TareResult:
        """Take the zero from the next ``n_frames`` frames; the pads must be untouched.

        The error of the zero is the noise over the square root of ``n_frames``. It adds to every
        later force, for each touched taxel.

        Raises TareRefused for touched pads, drifting counts or too many bad taxels; the earlier
        zero stays. Raises FrameTimeout without a frame for ``timeout_s``.
        """
        frames: list[TactileFrame] = []
        self.poll()
        while len(frames) < n_frames:
            failure = (
                f"{len(frames)} of {n_frames} frames for the tare, none within {timeout_s:g} s"
            )
            frames += self._waited(lambda: self.source.poll().frames, timeout_s, failure)
        counts = np.stack([frame.counts for frame in frames[:n_frames]])
        result = compute_tare(self._hood, counts, self._settings, frames[n_frames - 1].t_s)
        self._frames.clear()
        self.tare_result = result
        least = self._settings.noise_share * self.layout.adc_max
        noise = typical_noise(self.layout, result.noise_counts, least)
        self._touch = ActiveTaxels(self._hood, noise / np.sqrt(self._settings.mean_frames))
        self._quality.restart(result, frames[n_frames - 1])
        self._write_zero(result)
        return result

    def _write_zero(self, tare: TareResult) -> None:
        """Set the noise, and for force messages of the source the zero and what fails now."""
        self._force_bad = None
        noise_counts = np.maximum(tare.noise_counts, _ROUNDING_COUNTS)
        self._pad_noise_n = self.layout.medians(self._per_count_n * noise_counts)
        if self.identity is None or not self.identity.sends_forces:
            return
        grip = np.r_[self.layout.gripping_taxels]
        bad, noise = self._quality.bad, float(np.median(tare.noise_counts[grip]))
        least_counts = _TOUCH_SHARE * self.layout.adc_max
        self._touch_counts = max(_TOUCH_SIGMAS * _SOURCE_GAIN * noise, least_counts)
        self.source.set_zero(
            PadZero(
                offset_counts=tare.offset_counts[grip],
                touch_counts=self._touch_counts,
                bad=bad[grip],
            )
        )
        self._new_forces.clear()
        self._force_check.reset(sqrt(max(self._grip_noise_n2)))
        self._force_bad = bad

    def aim(self, force_n: float, aperture_m: float) -> None:
        """Set the set-point of the force in N and the opening between the pads in m.

        Frozen samples of a sensor without noise are found only by a comparison with these.
        """
        self._quality.aim(force_n, aperture_m)

    def check_zero(self) -> None:
        """Compare the newest reading of untouched pads with the zero, before a grasp.

        If a taxel has failed since the tare, the zero is set again, which takes some ms.

        Before the first tare, and before the first reading after it, nothing is compared.

        Raises
        ------
        ZeroDrifted
            If a whole pad has drifted: forces and shapes measured with this zero are wrong.
        """
        if self.tare_result is not None and self._force_bad is not None and not self.has_forces:
            self._write_zero(self.tare_result)
        if self.latest is not None and self._mean_full:
            latest = self.latest
            drift = self._quality.drift_anywhere(latest.tared_counts, latest.bad | latest.saturated)
            if drift:
                raise ZeroDrifted(drift)

    def _waited(
        self, poll: Callable[[], tuple[_Item, ...]], timeout_s: float, failure: str
    ) -> tuple[_Item, ...]:
        """Poll until something has arrived; FrameTimeout with ``failure`` after a time in s."""
        deadline_s = self._clock.monotonic() + timeout_s
        while not (arrived := poll()):
            left_s = deadline_s - self._clock.monotonic()
            if left_s <= 0.0:
                raise FrameTimeout(f"{failure}: check supply and line of the sensor")
            self._clock.sleep(min(left_s, _POLL_S))
        return arrived

    def _reading(self, frame: TactileFrame) -> TactileReading:
        last = self._quality.last
        if last is not None and frame.t_s - last.t_s > _GAP_S:
            self._frames.clear()
        touched = self.latest is not None and bool(self.latest.active.any())
        self._quality.step(frame, touched=touched)
        saturated = frame.counts >= self.layout.adc_max
        tare = self.tare_result
        counts = frame.counts.astype(np.float64)
        bad = self._quality.bad
        full = saturated & ~bad
        if tare is not None:
            counts -= tare.offset_counts
        counts = fill_bad(self._hood, counts, bad)
        self._frames.append(counts)
        # With an array for each frame, summing is faster than np.mean over the queue.
        tared = sum(self._frames, np.zeros_like(counts)) / len(self._frames)
        active = np.zeros_like(bad) if self._touch is None else self._touch.step(tared)
        force_n = np.where(active, self.calibration.force_n(tared), 0.0)
        all_n = self.calibration.force_n(counts)
        scan_n = np.where(active, all_n, 0.0)
        noise_n, summed = self._taxel_noise_n(counts, all_n), active
        if self.has_forces:
            # In its messages the unit also adds the neighbours of touched taxels.
            summed = self._hood.with_neighbours(active)
        full_scale = self._full_scale(full)
        reason = self._objection(frame, full_scale, bad, saturated | bad, tared)
        for array in (tared, active, force_n, saturated, bad):
            array.setflags(write=False)
        counted = self.statistics
        counted.bad_taxels = int(np.count_nonzero(bad))
        counted.saturated_frames += bool(full.any())
        counted.void_frames += bool(reason) and self._mean_full and tare is not None
        reading = TactileReading(
            frame=frame,
            tared_counts=tared,
            force_n=force_n,
            finger_force_n=self.layout.on_fingers(force_n),
            scan_force_n=self.layout.on_fingers(scan_n),
            centre_noise_taxels=self._centres.noise(scan_n, noise_n * summed),
            active=active,
            saturated=saturated,
            bad=bad,
            ok=not reason,
            at_least=bool(reason) and reason == full_scale,
            reason=reason,
        )
        if reading.ok and self.has_forces:
            self._compare(reading, counts, scan_n, all_n, noise_n)
        return reading

    def _taxel_noise_n(self, counts: Values, all_n: Values) -> Values:
        """Return the noise of the force on each taxel in one frame in N; 0 before the zero."""
        if self.tare_result is None:
            return np.zeros_like(counts)
        # A count is more force on a loaded taxel than on an empty one.
        slope = (self.calibration.force_n(counts + 1.0) - all_n) / self._per_count_n
        noise_n: Values = slope * self._pad_noise_n[self.layout.taxel_pad]
        return noise_n

    def _compare(
        self,
        reading: TactileReading,
        counts: Values,
        scan_n: Values,
        all_n: Values,
        noise_n: Values,
    ) -> None:
        variance_n2 = max(self.layout.on_fingers(reading.active * noise_n**2))
        variance_n2 = max(variance_n2, *(_LEAST_TOUCHED * self._grip_noise_n2))
        # The messages may leave out taxels that are not beside one above the source's threshold.
        above = self._hood.weighted(counts) / _BINOMIAL > self._touch_counts
        self._force_check.compare(
            reading.frame.scanned_s,
            self.layout.on_fingers(np.where(self._hood.with_neighbours(above), scan_n, 0.0)),
            sqrt(_EDGE * variance_n2),
            centre_taxels=self._centres.of(scan_n),
            centre_noise_taxels=reading.centre_noise_taxels,
            whole_n=self.layout.on_fingers(all_n),
        )

    @property
    def _grip_noise_n2(self) -> NDArray[np.float64]:
        """Variance in N² of a taxel of each gripping pad, (2,)."""
        noise_n2: NDArray[np.float64] = self._pad_noise_n[list(self.layout.gripping_pads)] ** 2
        return noise_n2

    @property
    def _mean_full(self) -> bool:
        """Whether the mean is over all its frames."""
        return len(self._frames) == self._frames.maxlen

    def _objection(
        self, frame: TactileFrame, full_scale: str, bad: Mask, void: Mask, tared: Values
    ) -> str:
        """Return why the forces of a frame may not be used, else ""."""
        if self.tare_result is None:
            return "not tared since the start"
        if frame.status & ScanStatus.CONVERTER_FAULT:
            return "the unit's converter failed its self-test"
        if not self._mean_full:
            return "too few frames since the tare or the last gap"
        if full_scale:
            return full_scale
        for finger, taxels in enumerate(self.layout.gripping_taxels):
            n_bad = int(np.count_nonzero(bad[taxels]))
            if too_many_bad(n_bad, taxels.stop - taxels.start, self._settings.bad_share):
                return f"{n_bad} taxels of finger {finger} bad"
        return self._quality.drift_outside(tared, void)

    def _full_scale(self, saturated: Mask) -> str:
        for finger, taxels in enumerate(self.layout.gripping_taxels):
            if n_full := np.count_nonzero(saturated[taxels]):
                return f"{n_full} taxels of finger {finger} saturated: press with less force"
        return ""


class TaxelForces:
    """Converts counts of single frames to newtons for displays, as the sensor does with a mean."""

    def __init__(self, layout: TaxelLayout, calibration: Calibration, zero: TareResult) -> None:
        self._hood = Neighbourhood(layout)
        self._calibration = calibration
        self._zero = zero
        # Counts are integers, so smaller noise is not visible.
        noise = typical_noise(layout, zero.noise_counts, 1.0)
        self._untouched = ActiveTaxels(self._hood, noise)

    def of(self, counts: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return the force in N on each taxel, (n_taxels,) float32; 0 on untouched taxels."""
        bad = self._zero.health.bad
        tared = fill_bad(self._hood, counts - self._zero.offset_counts, bad)
        # A copy, because frames are independent and come from several threads.
        active = copy(self._untouched).step(tared)
        force_n = np.where(active, self._calibration.force_n(tared), 0.0)
        return np.maximum(force_n, 0.0).astype(np.float32)
