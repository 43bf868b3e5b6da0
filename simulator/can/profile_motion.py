"""Motion of one simulated axis: set-point generator, mechanism that follows it, limit switches."""

import math

FOLLOWING_TIME_CONSTANT_S = 0.004
"""Time constant in s of the mechanism behind the set-point; an assumption."""


class ProfileMotion:
    """Set-point with bounded velocity and acceleration, and the mechanism behind it; increments.

    Parameters
    ----------
    position
        Position of the mechanism at the start in increments.
    low, high
        Positions of the limit switches.
    """

    def __init__(self, position: float, low: float, high: float) -> None:
        self.demand = self.actual = position
        self.speed = self.actual_speed = 0.0
        """Set-point and mechanism: place in increments, velocity in increments/s."""
        self.braking = 0.0
        """Deceleration in increments/s² of a running stop; 0: no stop."""
        self._goal: float | None = None
        self._limits = (0.0, 0.0)
        self._switches = (low, high)

    @property
    def resting(self) -> bool:
        """Whether the set-point is at its goal."""
        return self._goal is None and self.speed == 0.0

    def switches(self, forced: int) -> tuple[bool, bool]:
        """Return whether the negative and the positive limit switch are active.

        ``forced`` is -1 or 1 for a switch that is always active, 0 for none.
        """
        low, high = self._switches
        return self.actual <= low or forced < 0, self.actual >= high or forced > 0

    def go(self, goal: float, velocity: float, acceleration: float) -> None:
        """Move to a goal within a velocity and an acceleration."""
        self._goal, self._limits = goal, (velocity, acceleration)
        self.braking = 0.0

    def stop(self, deceleration: float) -> None:
        """Brake to standstill."""
        self._goal, self.braking = None, deceleration

    def freeze(self) -> None:
        """Stop at once at the mechanism's position: the power stage is off."""
        self.demand, self.speed, self._goal, self.braking = self.actual, 0.0, None, 0.0

    def step(self, dt_s: float, *, blocked: bool) -> None:
        """Move on by ``dt_s`` s; a mechanism that is blocked stays where it is."""
        wanted, change = 0.0, self.braking
        if self._goal is not None:
            velocity, change = self._limits
            left = self._goal - self.demand
            wanted = math.copysign(min(velocity, math.sqrt(2.0 * change * abs(left))), left)
        most = change * dt_s
        self.speed += min(max(wanted - self.speed, -most), most)
        self.demand += self.speed * dt_s
        if self._goal is not None and abs(self._goal - self.demand) <= 0.5 + abs(wanted) * dt_s:
            self.demand, self.speed, self._goal = self._goal, 0.0, None
        self.actual_speed = 0.0
        if not blocked:
            share = 1.0 - math.exp(-dt_s / FOLLOWING_TIME_CONSTANT_S)
            way = (self.demand - self.actual) * share
            self.actual += way
            self.actual_speed = way / dt_s
