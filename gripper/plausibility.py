"""Is the feedback possible at all? A finger cannot leap, and no servo draws twice its limit."""

from gripper.errors import FeedbackImplausible, LimitExceeded
from gripper.kinematics import Linkage
from gripper.settings import GripperSettings
from gripper.state import ServoState

_SPEED_RESERVE = 1.5
_LEAP_RAD = 0.05
_LONGEST_S = 0.5
_BEYOND_CLOSED_RAD = 0.08
_BEYOND_CLOSED_M = 0.004
_BEYOND_OPEN_RAD = 0.5
_CURRENT_RESERVE = 1.5
_CURRENT_MORE_A = 0.3

_ADVICE = (
    "where the finger is, is unknown, so the torque is switched off and a held part possibly "
    "dropped. Check encoder, horn and linkage before clearing the fault"
)


class FeedbackCheck:
    """Compares the feedback of servos under torque with what their fingers can do.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings, linkage: Linkage) -> None:
        self._settings = settings
        self._linkage = linkage
        self._lowest_rad = tuple(
            angle - max(_BEYOND_CLOSED_RAD, _BEYOND_CLOSED_M / linkage.opening_per_rad_m(angle))
            for angle in linkage.angles_rad(0.0)
        )
        self._highest_rad = tuple(
            angle + _BEYOND_OPEN_RAD for angle in linkage.angles_rad(settings.aperture_open_m)
        )
        self._last: dict[int, tuple[float, float]] = {}

    def forget(self) -> None:
        """Begin anew: what was seen before says nothing about what comes."""
        self._last.clear()

    def check(self, servos: tuple[ServoState, ...], now_s: float) -> None:
        """Return where the feedback of one transaction is possible.

        Parameters
        ----------
        servos
            Feedback of the servos, whose torque is on.
        now_s
            Monotonic time after the answer in s.

        Raises
        ------
        FeedbackImplausible
            Where a finger has leapt or stands where it cannot be, or a current cannot be.
        """
        for index, servo in enumerate(servos):
            self._check_current(index, servo)
            last = self._last.get(servo.servo_id)
            self._last[servo.servo_id] = (now_s, servo.angle_rad)
            if last is None:
                self._check_link(servo)
                continue
            last_s, last_rad = last
            model = self._settings.servos[index].servo_model
            passed_s = now_s - last_s
            farthest_rad = _SPEED_RESERVE * model.no_load_rad_s * passed_s + _LEAP_RAD
            if passed_s < _LONGEST_S and abs(servo.angle_rad - last_rad) > farthest_rad:
                raise FeedbackImplausible(
                    f"servo {servo.servo_id}: its position leapt by "
                    f"{servo.angle_rad - last_rad:+.3f} rad within {passed_s * 1e3:.0f} ms, "
                    f"at most {farthest_rad:.3f} rad are possible: {_ADVICE}"
                )
            self._check_range(index, servo, last_rad)
            self._check_link(servo)

    def _check_current(self, index: int, servo: ServoState) -> None:
        settings = self._settings
        model = settings.servos[index].servo_model
        most_a = min(
            _CURRENT_RESERVE * settings.current_max_a + _CURRENT_MORE_A,
            _CURRENT_RESERVE * model.stall_current_a,
        )
        if abs(servo.current_a) > most_a:
            raise FeedbackImplausible(
                f"servo {servo.servo_id}: it reports {servo.current_a:.2f} A, at most "
                f"{most_a:.2f} A are possible with current_max_a = {settings.current_max_a} A: "
                f"{_ADVICE}"
            )

    def _check_range(self, index: int, servo: ServoState, last_rad: float) -> None:
        low_rad, high_rad = self._lowest_rad[index], self._highest_rad[index]
        # Fingers that were left outside by hand may be brought back in.
        if low_rad <= last_rad <= high_rad and not low_rad <= servo.angle_rad <= high_rad:
            raise FeedbackImplausible(
                f"servo {servo.servo_id}: its finger stands at {servo.angle_rad:.3f} rad, it can "
                f"be from {low_rad:.3f} to {high_rad:.3f} rad: {_ADVICE}"
            )

    def _check_link(self, servo: ServoState) -> None:
        try:
            self._linkage.opening_per_rad_m(servo.angle_rad)
        except LimitExceeded as error:
            raise FeedbackImplausible(f"servo {servo.servo_id}: {error}. {_ADVICE}") from None
