"""The force that the loop aims at: the ramp's set-point, arriving at each level without a knee."""

_ARRIVED_N = 0.02


class Reference:
    """Follows the set-point and slows down before the end of a change of force.

    The moving masses and the part are a swing with little damping: where the rate of the force
    ends with a knee, the force runs on. The reference never is beyond the set-point and never
    faster; its rate is at most the force that is left over ``end_time_s``.

    Parameters
    ----------
    force_n
        Force at the beginning in N.
    end_time_s
        Time constant of the arrival in s; 0 follows the set-point itself.
    """

    def __init__(self, force_n: float, end_time_s: float) -> None:
        self._end_time_s = end_time_s
        self.force_n = force_n
        self.rate_n_s = 0.0

    def step(self, dt_s: float, setpoint_n: float, end_n: float) -> float:
        """Advance by ``dt_s`` s and return the force in N.

        Parameters
        ----------
        dt_s
            Time since the last step in s.
        setpoint_n
            Where the ramp is.
        end_n
            Where the present change of force ends.
        """
        left_n = end_n - self.force_n
        if self._end_time_s <= 0.0 or abs(left_n) <= _ARRIVED_N:
            force_n = setpoint_n
        else:
            share = min(1.0, dt_s / self._end_time_s)
            limit_n = self.force_n + left_n * share
            force_n = min(setpoint_n, limit_n) if left_n > 0.0 else max(setpoint_n, limit_n)
        self.rate_n_s = (force_n - self.force_n) / dt_s if dt_s > 0.0 else 0.0
        self.force_n = force_n
        return force_n
