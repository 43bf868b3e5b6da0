"""How stiff the gripped part is, from the first touch on: force seen against opening travelled."""

from collections import deque

from gripper.force import ForceSample

_HISTORY_LENGTH = 128
_MEAN_SAMPLES = 3
_SHORTEST_M = 1e-4
_STIFFEST_N_M = 1e5


class Compliance:
    """Learns the slope of grip force over opening; it need not be exact to tell foam from steel.

    Parameters
    ----------
    touch_n
        Grip force in N below which a sample shows no touch.
    sensor_delay_s
        Time in s by which the sensor's filters lag behind the stamp of a sample.
    step_n
        Growth of the force in N over which one slope is taken.
    """

    def __init__(self, *, touch_n: float, sensor_delay_s: float, step_n: float = 0.7) -> None:
        self._touch_n = touch_n
        self._delay_s = sensor_delay_s
        self._step_n = step_n
        self._apertures: deque[tuple[float, float]] = deque(maxlen=_HISTORY_LENGTH)
        self._pairs: deque[tuple[float, float]] = deque(maxlen=_MEAN_SAMPLES)
        self._anchor: tuple[float, float] | None = None
        self._sample_s: float | None = None
        self._stiffness_n_m: float | None = None

    @property
    def stiffness_n_m(self) -> float | None:
        """Grip force gained for each m that the opening shrinks, None before it is known."""
        return self._stiffness_n_m

    def push(self, now_s: float, aperture_m: float, sample: ForceSample | None) -> None:
        """Take the opening of now and the newest sample, which may be the same as before."""
        self._apertures.append((now_s, aperture_m))
        if sample is None or not sample.valid or sample.t_s == self._sample_s:
            return
        self._sample_s = sample.t_s
        there_m = self._aperture_at(sample.t_s - self._delay_s)
        if sample.grip_n < self._touch_n:
            self._anchor = (sample.grip_n, there_m)
            self._pairs.clear()
            return
        self._pairs.append((sample.grip_n, there_m))
        if self._anchor is None or len(self._pairs) < _MEAN_SAMPLES:
            return
        mean_n = sum(pair[0] for pair in self._pairs) / _MEAN_SAMPLES
        mean_m = sum(pair[1] for pair in self._pairs) / _MEAN_SAMPLES
        if mean_n - self._anchor[0] >= self._step_n:
            travel_m = max(self._anchor[1] - mean_m, _SHORTEST_M)
            self._stiffness_n_m = min((mean_n - self._anchor[0]) / travel_m, _STIFFEST_N_M)
            self._anchor = (mean_n, mean_m)

    def _aperture_at(self, t_s: float) -> float:
        for then_s, aperture_m in reversed(self._apertures):
            if then_s <= t_s:
                return aperture_m
        return self._apertures[0][1]
