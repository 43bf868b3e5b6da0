"""Doubt whether a gripped part is there: its stages, their evidence and their ends.

Force samples alone do not decide: a control unit with zero messages would let a held part go.
Another measurement must confirm them: fingers that run together, or a newer whole frame. If a frame
still shows load, or the motors press and the fingers stand, the measurements contradict each other:
this is a fault, and the grip is kept.
"""

from typing import NamedTuple

from gripper.errors import GripContradicted
from gripper.force.estimates.history import History
from gripper.force.loop import Moment
from gripper.force.supervision.pad_samples import FrameMean, PadSamples
from gripper.values.recent import FRAME_S
from gripper.values.state import GRAIN_M, STANDING_M_S

_EMPTY_TIME_S = 5 * FRAME_S
"""Time in s for which pads must be empty before a part may be lost: five frames."""
_RUN_M_S, RUN_M = 0.008, 3 * GRAIN_M
"""Growth of the closing speed in m/s, and travel in m, above which nothing holds the fingers apart:
three counts of the servos' velocity, three counts of an encoder. On a part fingers come to rest
under a constant drive. [resolution]"""
_FIRM_N_M = 1000.0
"""Least stiffness in N/m of a part with which this travel is no oscillation. [tuned]"""
_FOLLOWS_S = 0.03
"""Time in s for which fingers on a part keep their speed under a constant drive. [tuned]"""
SOFTEST_N_M = 200.0
"""Stiffness in N/m of a part with unknown stiffness: foam. [chosen]"""
_STAND_S, _STAND_M, _STAND_M_S = 0.04, GRAIN_M, 1.5 * STANDING_M_S
"""Time in s, and limits of travel in m and speed in m/s, of standing fingers: free fingers travel
several times as far with a drive of `_PRESSING_N`. [tuned]"""
_PRESSING_N, BREAKAWAY_SHARE = 1.0, 0.3
"""Driving force in N beyond friction at rest that certainly moves free fingers, and the largest
ratio of that friction to friction in motion. [assumed]"""
_UNDECIDED_S = 0.3
"""Longest time in s until another measurement confirms the loss; then it counts as contradicted.
[chosen]"""
ADVICE = (
    "A part that one of them still shows is not let go: the goals are frozen and the grip kept. "
    "Look at the part, check control unit, pads and cable, then clear the fault and release"
)


class Motion(NamedTuple):
    """Fingers and their drive at one time."""

    t_s: float
    aperture_m: float
    closing_m_s: float
    drive_n: float


class Evidence(NamedTuple):
    """One period of supervision."""

    moment: Moment
    """Feedback and newest sample."""
    pads: PadSamples
    empty: bool
    sudden: bool
    """Newest samples; whether their mean shows empty pads, or the newest ones do at once."""
    motions: tuple[Motion, ...]
    """Samples of the look-back window, the newest last."""
    apertures: History
    """Opening of the last periods in m."""
    stiffness_n_m: float | None
    """Stiffness of the part in N/m; None while not known."""
    pressing_n: float
    """Force of the measured currents beyond friction at rest, in N."""


class Sure:
    """Stage without doubt: the samples show the part."""

    def enter(self, evidence: Evidence, before: "Sure") -> None:
        """Begin after another stage, by the evidence of this period."""

    def step(self, evidence: Evidence) -> None:
        """Add a period with a valid sample."""

    def lost(self, _evidence: Evidence) -> bool:
        """Return whether the part is gone, by the evidence of this period."""
        return False

    @property
    def lasts(self) -> bool:
        """Whether the evidence of the stage has lasted for long enough."""
        return False


class Suspected(Sure):
    """Stage in which the samples show empty pads, but not yet for long enough.

    It keeps the motion at its start, the force before, and the frames since.
    """

    began: Motion
    force_n: float
    frames: FrameMean

    def enter(self, evidence: Evidence, _before: Sure) -> None:
        """Begin with the first sample that shows empty pads."""
        sample = evidence.moment.sample
        assert sample is not None
        # The first fingers' motion that this sample may have missed.
        since_s = sample.t_s - 2.0 * sample.lag_s
        motions = evidence.motions
        self.began = next((m for m in reversed(motions) if m.t_s <= since_s), motions[0])
        self.force_n = evidence.pads.before_n
        self.frames = FrameMean(sample.t_s)
        self._empty_s = 0.0
        self.step(evidence)

    def step(self, evidence: Evidence) -> None:
        """Add a period with a valid sample."""
        if evidence.moment.sample is not None:
            self.frames.push(evidence.moment.sample)
        self._empty_s = self._empty_s + evidence.moment.dt_s if evidence.empty else 0.0

    @property
    def lasts(self) -> bool:
        """Whether the pads have been empty for long enough."""
        return self._empty_s > _EMPTY_TIME_S


class Doubted(Sure):
    """Stage in which the samples show no part: other measurements decide; the drive stays."""

    ran = False
    """Whether the fingers have run together, unlike on any firm part."""
    _suspected: Suspected

    def enter(self, evidence: Evidence, before: Sure) -> None:
        """Begin with what was suspected."""
        assert isinstance(before, Suspected)
        self._suspected, self._since_s = before, evidence.motions[-1].t_s
        self._shown = _shown(evidence.pads)

    def step(self, evidence: Evidence) -> None:
        """Add a period with a valid sample; GripContradicted when it shows the part again."""
        if evidence.pads.loaded_again(self._suspected.force_n):
            raise self._contradicted(evidence, f"now it is {_shown(evidence.pads)} again")
        self._suspected.step(evidence)

    def lost(self, evidence: Evidence) -> bool:
        """Return whether another measurement confirms the loss; else may raise GripContradicted.

        Free fingers without a drive also stand: `EmptyGrip` tests this before they open.
        """
        moment, motion, frames = evidence.moment, evidence.motions[-1], self._suspected.frames
        stiffness_n_m = evidence.stiffness_n_m or SOFTEST_N_M
        if _run(moment, motion, self._suspected.began, stiffness_n_m):
            self.ran = stiffness_n_m >= _FIRM_N_M
            return True
        if frames and min(frames.finger_means_n) > evidence.pads.loaded_n:
            first_n, second_n = frames.finger_means_n
            shows = f"a frame scanned since then shows {first_n:.2f} and {second_n:.2f} N"
            raise self._contradicted(evidence, shows)
        if evidence.pressing_n < _PRESSING_N:
            return bool(frames) or moment.sample is None or moment.sample.frame_s is None
        waited_s = motion.t_s - self._since_s
        if (
            waited_s >= _STAND_S
            and abs(evidence.apertures.at(motion.t_s - _STAND_S) - motion.aperture_m) <= _STAND_M
            and abs(motion.closing_m_s) <= _STAND_M_S
        ):
            shows = (
                f"the fingers stand at an opening of {1e3 * motion.aperture_m:.1f} mm although the "
                f"motors press with {evidence.pressing_n:.1f} N beyond friction"
            )
            raise self._contradicted(evidence, shows)
        if waited_s >= _UNDECIDED_S:
            raise self._contradicted(evidence, "neither frames nor fingers confirm that")
        return False

    def _contradicted(self, evidence: Evidence, shows: str) -> GripContradicted:
        since_ms = 1e3 * (evidence.moment.now_s - self._suspected.began.t_s)
        return GripContradicted(
            f"the force samples fell from {self._suspected.force_n:.2f} N to {self._shown} "
            f"{since_ms:.0f} ms ago, below {evidence.pads.empty_n:.2f} N a pad is empty; {shows}. "
            f"{ADVICE}"
        )


def _shown(pads: PadSamples) -> str:
    return "{:.2f} and {:.2f} N".format(*pads.recent.newest.force_n)


def _run(moment: Moment, motion: Motion, began: Motion, stiffness_n_m: float) -> bool:
    """Return whether all fingers have closed since then, unlike on any part.

    A grown drive makes a part yield, and the earlier drive does so for a moment; but on a part the
    fingers then become slower.
    """
    if any(servo.velocity_rad_s > 0.0 for servo in moment.state.servos):
        return False
    yields_m = max(0.0, motion.drive_n - began.drive_n) / stiffness_n_m
    travel_m = began.aperture_m - motion.aperture_m
    before_m_s = max(0.0, began.closing_m_s)
    before_m = before_m_s * min(motion.t_s - began.t_s, _FOLLOWS_S)
    far = travel_m >= RUN_M + yields_m + before_m and motion.closing_m_s >= before_m_s
    faster = motion.closing_m_s - before_m_s >= _RUN_M_S and travel_m >= yields_m
    return far or faster
