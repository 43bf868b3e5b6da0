"""The tactile sensor: whole frames in, forces on taxels, pads and fingers out."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile.calibration import Calibration
from tactile.clock import Clock
from tactile.errors import CalibrationError, FrameTimeout, ZeroDrifted
from tactile.filters import (
    MovingMean,
    Neighbourhood,
    Values,
    fill_bad,
)
from tactile.layout import TaxelLayout
from tactile.link_settings import NodeIdentity
from tactile.protocol import FrameStatus, TactileFrame
from tactile.quality import QualityWatch
from tactile.reading import SensorSettings, SensorStatistics, TactileReading
from tactile.tare import TareResult, compute_tare, too_many_bad
from tactile.touch import ActiveTaxels

__all__ = ["FrameSource", "SensorSettings", "TactileReading", "TactileSensor"]


class FrameSource(Protocol):
    """Where frames come from; `TactileLink` is one."""

    def start(self) -> NodeIdentity:
        """Begin."""
        ...

    def poll(self) -> tuple[TactileFrame, ...]:
        """Return the whole frames since the last call, oldest first; does not wait."""
        ...

    def close(self) -> None:
        """End."""
        ...


class TactileSensor:
    """Tares the frames of a link and turns them into forces.

    Parameters
    ----------
    link
        Source of frames.
    layout
        Its taxels.
    calibration
        Counts to forces; must be for the layout's full scale.
    clock
        Monotonic time.
    settings
        Filters and limits.
    """

    def __init__(
        self,
        link: FrameSource,
        layout: TaxelLayout,
        calibration: Calibration,
        *,
        clock: Clock,
        settings: SensorSettings | None = None,
    ) -> None:
        if calibration.adc_max != layout.adc_max:
            raise CalibrationError(
                f"the calibration is for a full scale of {calibration.adc_max} counts, layout "
                f"{layout.name} has {layout.adc_max}"
            )
        self._link = link
        self._layout = layout
        self._calibration = calibration
        self._clock = clock
        self._settings = settings or SensorSettings()
        self._hood = Neighbourhood(layout)
        self._mean = MovingMean(self._settings.mean_frames)
        self._quality = QualityWatch(self._hood, self._settings.quality, self._settings.mean_frames)
        self._pad_starts = [layout.taxels_of(pad).start for pad in range(layout.n_pads)]
        self._grips = tuple(layout.taxels_of(pad) for pad in layout.gripping_pads)
        self._reset()

    def _reset(self) -> None:
        self._mean.reset()
        self._tare: TareResult | None = None
        self._tare_status = 0
        self._touch: ActiveTaxels | None = None
        self._latest: TactileReading | None = None
        self._last_s: float | None = None
        self._frozen: FrameTimeout | None = None
        self._saturated_frames = self._void_frames = 0
        self._quality.begin(None)

    @property
    def layout(self) -> TaxelLayout:
        """The taxels."""
        return self._layout

    @property
    def latest(self) -> TactileReading | None:
        """The newest reading that `poll` has given, None before; its age is in its ``t_s``."""
        return self._latest

    @property
    def statistics(self) -> SensorStatistics:
        """What was noted since the start."""
        return SensorStatistics(
            bad_taxels=int(np.count_nonzero(self._quality.bad)),
            saturated_frames=self._saturated_frames,
            void_frames=self._void_frames,
        )

    @property
    def tare_result(self) -> TareResult | None:
        """The zero in use, None before the first tare after a start."""
        return self._tare

    def start(self) -> NodeIdentity:
        """Start the link; the zero of an earlier start is forgotten."""
        self._reset()
        return self._link.start()

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def poll(self) -> tuple[TactileReading, ...]:
        """Return the readings that came since the last call, oldest first; does not wait.

        Raises what the link raises, and FrameTimeout, from then on always, when the samples are
        frozen.
        """
        if self._frozen is not None:
            raise self._frozen
        readings = tuple(self._reading(frame) for frame in self._link.poll())
        if readings:
            self._latest = readings[-1]
        return readings

    def read(self, timeout_s: float = 0.5) -> TactileReading:
        """Wait for a reading newer than this call; FrameTimeout after ``timeout_s``."""
        self.poll()
        deadline_s = self._clock.monotonic() + timeout_s
        while not (readings := self.poll()):
            self._wait(deadline_s, f"no frame within {timeout_s:g} s")
        return readings[-1]

    def tare(self, n_frames: int = 100, timeout_s: float = 5.0) -> TareResult:
        """Take the zero from the next ``n_frames`` frames; the pads must be untouched.

        The error of the zero is the noise over the square root of ``n_frames``, and enters every
        later force on as many taxels as are touched.

        Raises TareRefused when they are not, when the counts drift or too many taxels are bad (the
        zero in use stays), and FrameTimeout when the frames do not come within ``timeout_s``.
        """
        frames: list[TactileFrame] = []
        self.poll()
        deadline_s = self._clock.monotonic() + timeout_s
        while len(frames) < n_frames:
            new = self._link.poll()
            frames += new
            if not new:
                self._wait(
                    deadline_s,
                    f"{len(frames)} of {n_frames} frames for the tare within {timeout_s:g} s",
                )
        counts = np.stack([frame.counts for frame in frames[:n_frames]])
        result = compute_tare(
            self._hood, counts, self._settings.tare_limits, frames[n_frames - 1].t_s
        )
        self._mean.reset()
        self._tare = result
        self._tare_status = frames[n_frames - 1].status
        self._touch = self._new_touch(result)
        self._last_s = None
        self._quality.begin(result, frames[n_frames - 1])
        return result

    def aim(self, force_n: float, aperture_m: float) -> None:
        """Tell which force is wanted in N and how far the pads are apart in m.

        A sensor without noise can only be seen to be frozen by samples that do not follow these.
        """
        self._quality.aim(force_n, aperture_m)

    def check_zero(self) -> None:
        """Compare the newest reading of untouched pads with the zero.

        Before the first tare, and before the first reading after it, there is nothing to compare.

        Raises
        ------
        ZeroDrifted
            When a pad as a whole has moved: forces and shapes measured with this zero are wrong.
        """
        if self._latest is not None and self._mean.full:
            latest = self._latest
            drift = self._quality.drift_anywhere(latest.tared_counts, latest.bad | latest.saturated)
            if drift:
                raise ZeroDrifted(drift)

    def _new_touch(self, tare: TareResult) -> ActiveTaxels:
        """Judge touches by the typical noise of each pad: a single taxel's is known too poorly."""
        noise = np.full(
            self._layout.n_taxels, self._settings.noise_floor_share * self._layout.adc_max
        )
        for pad in range(self._layout.n_pads):
            taxels = self._layout.taxels_of(pad)
            noise[taxels] = np.maximum(noise[taxels], np.median(tare.noise_counts[taxels]))
        noise /= np.sqrt(self._settings.mean_frames)
        return ActiveTaxels(self._hood, self._settings.touch, noise)

    def _wait(self, deadline_s: float, failure: str) -> None:
        left_s = deadline_s - self._clock.monotonic()
        if left_s <= 0.0:
            raise FrameTimeout(
                f"{failure}: check that the control unit is powered and that SYNC is running"
            )
        self._clock.sleep(min(left_s, self._settings.poll_s))

    def _reading(self, frame: TactileFrame) -> TactileReading:
        self._watch_changes(frame)
        saturated = frame.counts >= self._layout.adc_max
        tare = self._tare
        counts = frame.counts.astype(np.float64)
        bad = self._quality.bad
        if tare is not None:
            counts -= tare.offset_counts
        tared = self._mean.step(fill_bad(self._hood, counts, bad))
        active = np.zeros_like(bad) if self._touch is None else self._touch.step(tared)
        force_n = np.where(active, self._calibration.force_n(tared), 0.0)
        pad_force_n = np.add.reduceat(force_n, self._pad_starts)
        reason = self._objection(frame, saturated & ~bad, bad, tared)
        for array in (tared, active, force_n, pad_force_n, saturated, bad):
            array.setflags(write=False)
        self._saturated_frames += bool((saturated & ~bad).any())
        self._void_frames += bool(reason) and self._mean.full
        first, second = self._layout.gripping_pads
        return TactileReading(
            frame=frame,
            tared_counts=tared,
            force_n=force_n,
            pad_force_n=pad_force_n,
            finger_force_n=(float(pad_force_n[first]), float(pad_force_n[second])),
            active=active,
            saturated=saturated,
            bad=bad,
            ok=not reason,
            reason=reason,
        )

    def _watch_changes(self, frame: TactileFrame) -> None:
        last_s, self._last_s = self._last_s, frame.t_s
        if last_s is not None and frame.t_s - last_s > self._settings.gap_s:
            self._mean.reset()
        latest = self._latest
        try:
            self._quality.step(frame, touched=latest is not None and bool(latest.active.any()))
        except FrameTimeout as fault:
            self._frozen = fault
            raise

    def _objection(
        self,
        frame: TactileFrame,
        saturated: NDArray[np.bool_],
        bad: NDArray[np.bool_],
        tared: Values,
    ) -> str:
        if self._tare is None:
            return "not tared since the start"
        if frame.status & FrameStatus.CONVERTER_FAULT:
            return "the unit's converter failed its self-test"
        if (frame.status ^ self._tare_status) & FrameStatus.TARED:
            return "the unit has taken or dropped a zero of its own since the tare"
        if not self._mean.full:
            return "too few frames since the tare or the last gap"
        grip = self._grip_objection(saturated, bad)
        return grip or self._quality.drift_beside(tared, bad | saturated)

    def _grip_objection(self, saturated: NDArray[np.bool_], bad: NDArray[np.bool_]) -> str:
        for finger, taxels in enumerate(self._grips):
            if saturated[taxels].any():
                return f"{np.count_nonzero(saturated[taxels])} taxels of finger {finger} saturated"
            n_bad = int(np.count_nonzero(bad[taxels]))
            if too_many_bad(n_bad, taxels.stop - taxels.start, self._settings.bad_share):
                return f"{np.count_nonzero(bad[taxels])} taxels of finger {finger} bad"
        return ""
