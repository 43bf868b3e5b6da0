"""Loaded pads against the position of the fingers, and against each other."""

from gripper.errors import ForceImbalance, PositionContradicted
from gripper.force.loop import Moment
from gripper.force.supervision.pad_samples import PadSamples
from gripper.settings import GripperSettings
from gripper.values.recent import FRAME_S
from gripper.values.state import ServoFeedback

_CONTRADICTED_S = 5 * FRAME_S
"""Time in s for which loaded pads must contradict a position before an error: five frames."""
_SINKS_S, _CREEP_M = 0.1, 0.0005
"""Time in s after a rise until the fingers stand, and the distance in m by which foam may yield
after it: a sixth of the yield of two pads of 3 mm. [chosen]"""


class PadChecks:
    """Checks of the pads of one grip.

    Parameters
    ----------
    settings
        Of the gripper.
    contact, now_s
        Feedback at the contact, and monotonic time in s.
    widest_m
        Opening in m beyond which no part can press on both pads.
    """

    def __init__(
        self, settings: GripperSettings, contact: ServoFeedback, now_s: float, *, widest_m: float
    ) -> None:
        self._settings = settings
        self._widest_m = widest_m
        self._sunk_m, self._rose_s = contact.aperture_m, now_s
        self._contradicted_s = self._uneven_s = 0.0

    def resume(self) -> None:
        """Begin again after a pause."""
        self._uneven_s = 0.0

    def check(self, moment: Moment, pads: PadSamples, *, rises: bool) -> None:
        """Add one period.

        Parameters
        ----------
        moment, pads
            Feedback, and newest force samples.
        rises
            Whether the set-point is higher than in the last period.

        Raises
        ------
        PositionContradicted
            When pads are loaded although the fingers, by their position, cannot press on a part.
        ForceImbalance
            When the forces of the fingers differ for too long.
        """
        if rises:
            self._rose_s = moment.now_s
        if moment.now_s - self._rose_s <= _SINKS_S:
            self._sunk_m = moment.state.aperture_m
        self._check_position(moment.dt_s, moment.state, pads)
        self._check_balance(moment.dt_s, pads)

    def _check_position(self, dt_s: float, state: ServoFeedback, pads: PadSamples) -> None:
        """Raise PositionContradicted if loaded pads have contradicted the opening for long.

        No part presses on both pads of fingers that are wider open than at the contact, or closed:
        then a position drifts, but the part is still gripped. A small part in the foam may sink
        further by the creep of the foam.
        """
        least_m = min(self._settings.least_pressed_m, self._sunk_m - _CREEP_M)
        if least_m <= state.aperture_m <= self._widest_m or not pads.loaded:
            self._contradicted_s = 0.0
            return
        self._contradicted_s += dt_s
        if self._contradicted_s < _CONTRADICTED_S:
            return
        first_n, second_n = pads.recent.finger_means_n
        raise PositionContradicted(
            f"the servos report an opening of {state.aperture_m * 1e3:.1f} mm while the pads "
            f"measure {first_n:.2f} and {second_n:.2f} N on a part that can be from "
            f"{least_m * 1e3:.1f} to {self._widest_m * 1e3:.1f} mm wide: a position is wrong, or "
            f"the pads press on each other; the goals are frozen and the grip kept. Look at the "
            f"part, check encoder, horn and linkage, then clear the fault and release"
        )

    def _check_balance(self, dt_s: float, pads: PadSamples) -> None:
        """Raise ForceImbalance when the fingers' forces have differed for too long."""
        settings = self._settings
        first_n, second_n = pads.recent.finger_means_n
        allowed_n = max(settings.imbalance_n, settings.imbalance_share * 0.5 * (first_n + second_n))
        if abs(first_n - second_n) <= allowed_n:
            self._uneven_s = 0.0
            return
        self._uneven_s += dt_s
        if self._uneven_s > settings.imbalance_s:
            raise ForceImbalance(
                f"the fingers press with {first_n:.2f} and {second_n:.2f} N, a difference of "
                f"{allowed_n:.2f} N is allowed for {settings.imbalance_s} s: both are frozen; "
                f"check whether a finger is blocked or a pad is blind"
            )
