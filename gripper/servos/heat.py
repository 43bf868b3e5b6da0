"""Heat of a servo's winding by its current: I²t in the host, since the register lags by minutes.

The mean square of the current over the winding's time constant stands for its heat. It may exceed
that of the current which the model holds for hours, by what 2 s at its peak current add.
"""

from math import exp, inf, log

from gripper.dynamixel.models import ServoModel

_WINDING_S = 30.0
"""Time constant in s of the winding: 30 to 60 s, until it is measured. [assumed]"""
_PEAK_S = 2.0
"""Time in s for which `ServoModel.peak_a` is allowed at any time."""
_LOWERING_S = 0.5
"""Time constant in s with which a hot winding's current falls, so that no part is thrown. [chosen]
"""


class WindingHeat:
    """Heat of the winding of one servo, and the current that it allows.

    Once the heat is reached, the current falls to the holding current. It stays there until the
    winding is as cool as in a hold of hours.
    """

    def __init__(self, model: ServoModel) -> None:
        self._model = model
        self._square_a2 = 0.0
        self._most_a2 = model.holding_a**2 + _peak_a2(model)
        self._lowered_a: float | None = None
        self._last: tuple[float, float] | None = None

    @property
    def hot(self) -> bool:
        """Whether only the holding current is allowed."""
        return self._lowered_a is not None

    @property
    def limit_a(self) -> float:
        """Largest allowed current in A."""
        return self._model.stall_current_a if self._lowered_a is None else self._lowered_a

    def add(self, now_s: float, current_a: float) -> None:
        """Add a measured current in A at a monotonic time in s; it lasts until the next one."""
        if self._last is not None:
            dt_s, last_a = now_s - self._last[0], self._last[1]
            self._square_a2 += -(last_a**2 - self._square_a2) * (exp(-dt_s / _WINDING_S) - 1.0)
            if self._lowered_a is not None:
                above_a = self._lowered_a - self._model.holding_a
                self._lowered_a -= above_a * (1.0 - exp(-dt_s / _LOWERING_S))
        self._last = now_s, current_a
        if self._square_a2 >= self._most_a2 and self._lowered_a is None:
            self._lowered_a = max(abs(current_a), self._model.holding_a)
        elif self._square_a2 < self._model.holding_a**2:
            self._lowered_a = None


def longest_s(model: ServoModel, current_a: float) -> float:
    """Return the time in s for which a servo without heat may have a current in A."""
    most_a2 = model.holding_a**2 + _peak_a2(model)
    if current_a <= model.holding_a:
        return inf
    # A current just above the holding current ends as if it were a little higher.
    square_a2 = max(current_a**2, 1.001 * most_a2)
    return _WINDING_S * log(square_a2 / (square_a2 - most_a2))


def _peak_a2(model: ServoModel) -> float:
    return (model.peak_a**2 - model.holding_a**2) * (1.0 - exp(-_PEAK_S / _WINDING_S))
