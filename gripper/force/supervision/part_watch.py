"""Decision that a gripped part is gone: pads compared with frames, motors and opening."""

from collections import deque
from collections.abc import Callable

from gripper.force.estimates.grip import Grip
from gripper.force.loop import Moment
from gripper.force.supervision.doubt import (
    BREAKAWAY_SHARE,
    Doubted,
    Evidence,
    Motion,
    Sure,
    Suspected,
)
from gripper.force.supervision.pad_samples import PadSamples
from gripper.force.supervision.runaway import Runaway
from gripper.mechanics.kinematics import driving_n, mean_friction_n, transmissions
from gripper.values.recent import LOOK_BACK_S


class PartWatch:
    """Decides whether a gripped part is gone.

    Parameters
    ----------
    grip
        What is known of the grip; its owner adds to it.
    contact_n_m
        Stiffness in N/m that the first touch showed; None where it did not.
    """

    def __init__(self, grip: Grip, contact_n_m: float | None) -> None:
        self.pads = PadSamples(grip.settings)
        """Newest force samples."""
        self._grip = grip
        self._contact_n_m = contact_n_m
        self._motions: deque[Motion] = deque()
        self._runaway = Runaway(grip, self.pads)
        self._stages: dict[type[Sure], Sure] = {one: one() for one in (Sure, Suspected, Doubted)}
        self._stage = self._stages[Sure]
        self._was_held = self._ran = False

    @property
    def doubts(self) -> bool:
        """Whether the samples must not be used for control: they show a part as gone."""
        return isinstance(self._stage, Doubted)

    @property
    def ran(self) -> bool:
        """Whether the fingers have run together, unlike on any part."""
        return self._ran or (isinstance(self._stage, Doubted) and self._stage.ran)

    def resume(self) -> None:
        """Begin again after a pause: earlier values are discarded."""
        self.pads.clear()
        self._motions.clear()
        self._stage = self._stages[Sure]

    def lost(self, moment: Moment) -> bool:
        """Return whether the part is gone.

        It is gone in these cases: both pads are empty for some time, or suddenly after much force,
        and the fingers run or a frame is also empty; the fingers have closed fully and the pads are
        not loaded; the fingers run together without resistance. Time without samples, e.g. in a
        stall, does not count.

        Raises
        ------
        GripContradicted
            When the samples show empty pads but another measurement shows a part.
        """
        grip, pads, state, sample = self._grip, self.pads, moment.state, moment.sample
        closing_m_s = -state.aperture_velocity_m_s
        self._motions.append(Motion(moment.now_s, state.aperture_m, closing_m_s, grip.balance_n))
        while moment.now_s - self._motions[0].t_s > LOOK_BACK_S:
            self._motions.popleft()
        seen = sample is not None and sample.valid
        if sample is not None and seen:
            pads.take(sample)
            self._was_held |= grip.asked_n >= grip.settings.contact_force_n
        # If noise has ended the approach slightly early, no part can be lost.
        seen &= self._was_held
        paths = transmissions(grip.settings, grip.linkage, state.angles_rad)
        breakaway_n = (1.0 + BREAKAWAY_SHARE) * mean_friction_n(paths)
        stiffness_n_m = grip.stiffness.stiffness_n_m
        if stiffness_n_m is None:
            stiffness_n_m = self._contact_n_m
        empty, sudden = seen and pads.empty, seen and pads.suddenly_empty(grip.asked_n)
        pressing_n, motions = driving_n(state, paths) - breakaway_n, tuple(self._motions)
        evidence = Evidence(
            moment, pads, empty, sudden, motions, grip.apertures, stiffness_n_m, pressing_n
        )
        if seen:
            self._stage.step(evidence)
            while (target := self._due(evidence)) is not None:
                before, self._stage = self._stage, self._stages[target]
                self._stage.enter(evidence, before)
        closed = state.aperture_m < grip.settings.aperture_min_m and not pads.loaded
        runs_away = self._runaway.found(moment, stiffness_n_m)
        self._ran = closed or runs_away
        return self._ran or self._stage.lost(evidence)

    def _due(self, evidence: Evidence) -> type[Sure] | None:
        for source, condition, target in TRANSITIONS:
            if type(self._stage) is source and condition(self._stage, evidence):
                return target
        return None


TRANSITIONS: tuple[tuple[type[Sure], Callable[[Sure, Evidence], bool], type[Sure]], ...] = (
    (Sure, lambda _, seen: seen.empty or seen.sudden, Suspected),
    (Suspected, lambda _, seen: not (seen.empty or seen.sudden), Sure),
    (Suspected, lambda suspected, seen: seen.sudden or suspected.lasts, Doubted),
)
"""Stage of the doubt, condition of its end, and next stage. The last one ends with the loss of the
part, or with a contradiction, which is a fault."""
