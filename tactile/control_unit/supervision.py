"""Supervision of the control unit: boot-up, heartbeat, emergencies, bus errors.

Time is an argument. canopen does not supervise: it has no heartbeat consumer, hides boot-ups
and drops error frames. Every method raises a `LinkFault` at once if its message is a fault.
"""

from collections import deque

from canopen.emcy import EMCY_STRUCT, EmcyError
from canopen.nmt import COMMAND_TO_STATE, NMT_COMMANDS, NMT_STATES

from tactile.can.bus import ACTIVE, CLASS_CONTROLLER, PASSIVE
from tactile.errors import (
    BusDisturbed,
    BusErrorPassive,
    BusOff,
    DuplicateNode,
    HeartbeatLost,
    NodeEmergency,
    NodeRebooted,
    NodeStateChanged,
)

BOOT_UP = 0
"""State byte of a boot-up message (CiA 301, 7.2.8.3.3); canopen calls that state INITIALISING."""
OPERATIONAL = COMMAND_TO_STATE[NMT_COMMANDS["OPERATIONAL"]]
_STATE_BITS = 0x7F
"""Bits of the state in a heartbeat; the top bit is reserved."""

ERROR_RESET = 0x0000
WINDOW_EXCEEDED = 0xFF01
SYNC_OVERRUN = 0xFF02
CONVERTER_FAULT = 0xFF03
MULTIPLEXER_FAULT = 0xFF04
ZERO_LOST = 0xFF05
"""Emergency codes of the control unit; the first one is from CiA 301."""

_EMERGENCY_TEXTS = {
    ERROR_RESET: "no error",
    WINDOW_EXCEEDED: "a burst was cut short, it does not fit into the synchronous window",
    SYNC_OVERRUN: "a SYNC came while the burst before it was still being sent",
    CONVERTER_FAULT: "converter self-test failed",
    MULTIPLEXER_FAULT: "multiplexer self-test failed",
    ZERO_LOST: "the stored zero is damaged",
    0x8110: "CAN overrun, messages lost",
    0x8120: "CAN error-passive",
    0x8130: "heartbeat or life guard error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier collision",
    0x8210: "PDO not processed, too short",
    0x8220: "PDO too long",
    0x8230: "MPDO not processed, its destination object is missing",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO time-out",
}
"""Emergency codes with one meaning: those of the unit, and those of CiA 301, 7.2.7.1, that canopen
has only as groups."""

_EMERGENCY_CODE_BYTES = 2
"""Length of the code at the start of an emergency message (CiA 301, 7.2.7)."""

_DOUBLED_BEATS = 16
_DOUBLED_PERIODS = 10.0
"""Number of heartbeats within a number of periods that shows two units. A host that stalls for a
third of that time receives fewer."""

_CLASS_BUS_OFF = 0x0040
_CLASS_RESTARTED = 0x0100
"""Further classes of error frames in SocketCAN's identifier (linux/can/error.h)."""


def emergency_text(code: int) -> str:
    """Return the meaning of an emergency code, or of its group if it has no own meaning."""
    group: str = EmcyError(code, 0, b"", 0.0).get_desc()
    return _EMERGENCY_TEXTS.get(code) or group.lower() or "unknown code"


class TrafficLimit:
    """Limit of useless messages, a leaky bucket: messages fill it, time empties it.

    Parameters
    ----------
    what
        The messages, in the plural, for the error.
    advice
        Remedy.
    rate_hz
        Sustained rate allowed in 1/s.
    burst
        Allowed number of messages at once.
    """

    def __init__(self, what: str, advice: str, *, rate_hz: float, burst: float) -> None:
        self._what = what
        self._advice = advice
        self._rate_hz = rate_hz
        self._burst = burst
        self._level = 0.0
        self._since_s: float | None = None
        self._at_s = 0.0
        self._n = 0

    def add(self, t_s: float, n: int = 1) -> None:
        """Add ``n`` messages at ``t_s`` s; BusDisturbed if they are too many."""
        self._level = max(0.0, self._level - self._rate_hz * max(0.0, t_s - self._at_s))
        if self._level == 0.0 or self._since_s is None:
            self._since_s, self._n = t_s, 0
        self._at_s = t_s
        self._level += n
        self._n += n
        if self._level > self._burst:
            raise BusDisturbed(
                f"{self._n} {self._what} came within {1e3 * (t_s - self._since_s):.0f} ms, "
                f"allowed are {self._rate_hz:g} a second: {self._advice}, then start the link again"
            )


class NodeSupervisor:
    """Supervisor of one node: its state, its heartbeat, its emergencies, the host's controller.

    Parameters
    ----------
    heartbeat_s, heartbeat_factor
        Period of the unit's heartbeat in s, and the number of periods after which it is lost.
    passive_s
        Longest time in s in which the host's controller may be error-passive.
    """

    def __init__(
        self,
        name: str,
        *,
        heartbeat_s: float,
        heartbeat_factor: float = 2.5,
        passive_s: float = 0.5,
    ) -> None:
        self._name = name
        self._heartbeat_s = heartbeat_s
        self._silence_s = heartbeat_factor * heartbeat_s
        self._passive_s = passive_s
        self._in_operation = False
        self._heartbeat_at_s: float | None = None
        self._beats: deque[float] = deque(maxlen=_DOUBLED_BEATS)
        self._passive_since_s: float | None = None
        self.state: int | None = None
        self.boot_ups = 0
        self.unusable = 0
        self.error_frames = 0

    def enter_operation(self, now_s: float) -> None:
        """Require from now on that the unit is operational and sends its heartbeat."""
        self._in_operation = True
        self._heartbeat_at_s = now_s

    def wait_longer(self, late_s: float) -> None:
        """Extend all deadlines by a stall of the host in s."""
        if self._heartbeat_at_s is not None:
            self._heartbeat_at_s += late_s
        if self._passive_since_s is not None:
            self._passive_since_s += late_s

    def on_heartbeat(self, data: bytes, t_s: float) -> None:
        """Process a message of COB-ID 0x700 + node; some units send a boot-up without data."""
        state = data[0] & _STATE_BITS if data else BOOT_UP
        if state != BOOT_UP and state not in NMT_STATES:
            # This state does not exist: a bit was flipped on the bus.
            self.unusable += 1
            return
        self.state = state
        self._heartbeat_at_s = max(t_s, self._heartbeat_at_s or t_s)
        if self.state == BOOT_UP:
            self.boot_ups += 1
            if self._in_operation:
                raise NodeRebooted(
                    f"{self._name} sent a boot-up message while in operation: it restarted, or a "
                    "second unit has the same node-ID; its set-up is gone, check its supply, then "
                    "start the link and tare again"
                )
        elif self._in_operation and self.state != OPERATIONAL:
            raise NodeStateChanged(
                f"{self._name} is {NMT_STATES[state].lower()}, expected operational: check for "
                "another NMT master and an error of the unit (1029h), then start the link again"
            )
        elif self._in_operation:
            self._count_beat(t_s)

    def _count_beat(self, t_s: float) -> None:
        self._beats.append(t_s)
        limit_s = _DOUBLED_PERIODS * self._heartbeat_s
        if len(self._beats) == _DOUBLED_BEATS and t_s - self._beats[0] < limit_s:
            raise DuplicateNode(
                f"{_DOUBLED_BEATS} heartbeats came from {self._name} within "
                f"{t_s - self._beats[0]:.2f} s, its period is {self._heartbeat_s:g} s: a "
                "second unit has the same node-ID; leave one on the bus, then start the link again"
            )

    def on_emergency(self, data: bytes) -> None:
        """Process a message of COB-ID 0x080 + node: code, error register, 5 more bytes (CiA 301).

        A shorter one with its code is an emergency, too: its sender has an error.
        """
        if len(data) < _EMERGENCY_CODE_BYTES:
            self.unusable += 1
            return
        code, register, _ = EMCY_STRUCT.unpack(data.ljust(EMCY_STRUCT.size, b"\0"))
        if code != ERROR_RESET:
            text = emergency_text(code)
            if len(data) < EMCY_STRUCT.size:
                text += f"; only {len(data)} of {EMCY_STRUCT.size} bytes arrived"
            raise NodeEmergency(code, register, text, self._name)

    def on_error_frame(self, classes: int, data: bytes | bytearray, t_s: float) -> None:
        """Process an error frame of the host's own CAN controller."""
        self.error_frames += 1
        if classes & _CLASS_BUS_OFF:
            raise BusOff(
                "the CAN controller of the host is bus-off: check wiring, termination and bit "
                "rate, restart the interface, then start the link again"
            )
        controller = data[1] if classes & CLASS_CONTROLLER and len(data) > 1 else 0
        if controller & ACTIVE or classes & _CLASS_RESTARTED:
            self._passive_since_s = None
        elif controller & PASSIVE and self._passive_since_s is None:
            self._passive_since_s = t_s

    def check(self, now_s: float) -> None:
        """Raise the fault of a missed deadline."""
        passive_since_s = self._passive_since_s
        if passive_since_s is not None and now_s - passive_since_s >= self._passive_s:
            raise BusErrorPassive(
                f"the CAN controller of the host has been error-passive for "
                f"{now_s - passive_since_s:.2f} s, allowed are {self._passive_s:g} s: check "
                "wiring, termination and bit rate, then start the link again"
            )
        if not self._in_operation or self._heartbeat_at_s is None:
            return
        silent_s = now_s - self._heartbeat_at_s
        if silent_s > self._silence_s:
            raise HeartbeatLost(
                f"no heartbeat from {self._name} for {silent_s:.3f} s, allowed are "
                f"{self._silence_s:g} s: check its supply and its CAN cable, then start the link "
                "again"
            )
