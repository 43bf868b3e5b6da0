"""Is an answer of a servo new? Its own clock (Realtime Tick, register 120) tells."""

from gripper.errors import BusCorrupt
from gripper.registers import TICK_MODULO

_GRAIN_S = 0.004
_RATE_ERROR = 0.03
_LONGEST_S = 10.0
_LATEST_S = 0.5


class TickWatch:
    """Compares the progress of each servo's tick with the host's clock.

    A tick that lags behind is an old answer taken for a new one; a tick that has jumped is a
    servo that has started anew.
    """

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, float, float]] = {}

    def forget(self) -> None:
        """Begin anew, after servos were restarted on purpose."""
        self._last.clear()

    def check(
        self, servo_id: int, tick_ms: int, sent_s: float, received_s: float
    ) -> BusCorrupt | None:
        """Return what is wrong with an answer, None when it is new.

        Parameters
        ----------
        servo_id
            Who answered.
        tick_ms
            Its tick in ms, modulo 32768.
        sent_s, received_s
            Host's time before the request and after the answer in s.
        """
        last = self._last.get(servo_id)
        now = (tick_ms, sent_s, received_s)
        if last is None:
            self._last[servo_id] = now
            return None
        last_tick_ms, last_sent_s, last_received_s = last
        least_s = max(0.0, sent_s - last_received_s)
        most_s = received_s - last_sent_s
        if most_s > _LONGEST_S:
            self._last[servo_id] = now
            return None
        passed_s = ((tick_ms - last_tick_ms) % TICK_MODULO) * 1e-3
        low_s = least_s * (1.0 - _RATE_ERROR) - _GRAIN_S
        high_s = most_s * (1.0 + _RATE_ERROR) + _GRAIN_S
        # A tick slightly back is a lag too, not a turn of the modulo; one far back is a restart.
        if passed_s > TICK_MODULO * 1e-3 - _LATEST_S:
            passed_s -= TICK_MODULO * 1e-3
        if passed_s >= low_s:
            self._last[servo_id] = now
        if low_s <= passed_s <= high_s:
            return None
        return BusCorrupt(
            f"the tick of servo {servo_id} moved by {passed_s * 1e3:.0f} ms while "
            f"{least_s * 1e3:.0f} to {most_s * 1e3:.0f} ms passed: an old answer, or the servo "
            f"has restarted"
        )
