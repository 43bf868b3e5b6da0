"""Doubt whether a gripped part is there: what its stages look at, and what ends it.

Force samples alone decide nothing: a control unit whose messages read zero would let a part go that
is held. What they show must be confirmed by another witness: fingers that run together, or a whole
frame that was scanned since. Where a frame still shows load, or the motors press and the fingers
stand, the witnesses contradict each other: that is a fault, and the grip is kept.
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
"""Growth of the closing speed in m/s, and way in m, from which on nothing holds the fingers apart:
three units of the servos' velocity, three counts of an encoder. On a part fingers come to rest
under a drive that stays as it is. [resolution]"""
_FIRM_N_M = 1000.0
"""Stiffness in N/m of a part from which on such a way is no swing of fingers and part. [tuned]"""
_FOLLOWS_S = 0.03
"""Time in s for which fingers that press on a part go on at their speed though the drive stays.
[tuned]"""
SOFTEST_N_M = 200.0
"""Stiffness in N/m of a part whose own is not known yet: foam. [chosen]"""
_STAND_S, _STAND_M, _STAND_M_S = 0.04, GRAIN_M, 1.5 * STANDING_M_S
"""Time in s after which fingers that have moved by no more than so many m, and are no faster than
so many m/s, stand: free ones have gone several times as far where the drive is `_PRESSING_N`.
[tuned]"""
_PRESSING_N, BREAKAWAY_SHARE = 1.0, 0.3
"""Driving force in N beyond friction at rest that moves free fingers for certain, and the share by
which that friction is larger than in motion, at most. [assumed]"""
_UNDECIDED_S = 0.3
"""Longest time in s until a witness confirms the loss; then it counts as contradicted. [chosen]"""
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
    """Those of the look-back window, the newest last."""
    apertures: History
    """Opening of the last periods in m."""
    stiffness_n_m: float | None
    """That of the part in N/m; None while it is not known."""
    pressing_n: float
    """What the measured currents make beyond friction at rest, in N."""


class Sure:
    """Stage without doubt, the samples show the part; what the other stages begin from."""

    def enter(self, evidence: Evidence, before: "Sure") -> None:
        """Begin after another stage, by the evidence of this period."""

    def step(self, evidence: Evidence) -> None:
        """Take in a period with a valid sample."""

    def lost(self, _evidence: Evidence) -> bool:
        """Return whether the part is gone, by all that this period shows."""
        return False

    @property
    def lasts(self) -> bool:
        """Whether what the stage looks at has lasted for long enough."""
        return False


class Suspected(Sure):
    """Stage in which the samples show empty pads, not for long enough yet.

    It keeps the motion when that began, the force before, and the frames since.
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
        """Take in a period with a valid sample."""
        if evidence.moment.sample is not None:
            self.frames.push(evidence.moment.sample)
        self._empty_s = self._empty_s + evidence.moment.dt_s if evidence.empty else 0.0

    @property
    def lasts(self) -> bool:
        """Whether the pads have been empty for long enough."""
        return self._empty_s > _EMPTY_TIME_S


class Doubted(Sure):
    """Stage in which the samples show a part as gone: another witness decides, the drive stays."""

    ran = False
    """Whether the fingers have run together as they do on no firm part."""
    _suspected: Suspected

    def enter(self, evidence: Evidence, before: Sure) -> None:
        """Begin with what was suspected."""
        assert isinstance(before, Suspected)
        self._suspected, self._since_s = before, evidence.motions[-1].t_s
        self._shown = _shown(evidence.pads)

    def step(self, evidence: Evidence) -> None:
        """Take in a period with a valid sample; GripContradicted when it shows the part again."""
        if evidence.pads.loaded_again(self._suspected.force_n):
            raise self._contradicted(evidence, f"now it is {_shown(evidence.pads)} again")
        self._suspected.step(evidence)

    def lost(self, evidence: Evidence) -> bool:
        """Return whether another witness confirms the loss; GripContradicted where one denies it.

        Free fingers would stand as well where nothing presses: `EmptyGrip` tries whether they do
        before they open.
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
    """Return whether all fingers have closed since then as they do on no part.

    What the drive has grown by makes a part yield, and what it was before does so for a moment; but
    on a part the fingers become slower then.
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
