"""Supervision of the control unit: boot-up, heartbeat, emergencies, bus errors.

Time is an argument. This is what canopen leaves to its user: it has no heartbeat consumer, hides
boot-ups and drops error frames. Every method raises a `LinkFault` at once when what it is told is
one.
"""

from collections import deque
from dataclasses import dataclass

from tactile.emergency import ERROR_RESET, decode_emergency
from tactile.errors import (
    BusErrorPassive,
    BusOff,
    DuplicateNode,
    HeartbeatLost,
    NodeEmergency,
    NodeRebooted,
    NodeStateChanged,
)

BOOT_UP = 0
STOPPED = 4
OPERATIONAL = 5
PRE_OPERATIONAL = 127
NMT_STATES = {
    BOOT_UP: "boot-up",
    STOPPED: "stopped",
    OPERATIONAL: "operational",
    PRE_OPERATIONAL: "pre-operational",
}

_DOUBLED_BEATS = 16
_DOUBLED_PERIODS = 10.0
"""So many heartbeats within so many periods are those of two units; a host that stalls for a third
of that time sees fewer."""

# Error frames as SocketCAN puts them (linux/can/error.h): classes in the identifier, and the
# controller's state in data byte 1.
_CLASS_CONTROLLER = 0x0004
_CLASS_BUS_OFF = 0x0040
_CLASS_RESTARTED = 0x0100
_PASSIVE = 0x10 | 0x20
_ACTIVE = 0x40


@dataclass(frozen=True, slots=True, kw_only=True)
class SupervisionLimits:
    """What the supervisor allows.

    Attributes
    ----------
    heartbeat_s
        Period of the unit's heartbeat in s.
    heartbeat_factor
        The heartbeat is lost after this many periods without one.
    passive_s
        The controller may be error-passive for this long.
    """

    heartbeat_s: float
    heartbeat_factor: float = 1.5
    passive_s: float = 0.5


class NodeSupervisor:
    """What is known of one node's health.

    Parameters
    ----------
    name
        The node in messages.
    limits
        Deadlines.
    """

    def __init__(self, name: str, limits: SupervisionLimits) -> None:
        self._name = name
        self._limits = limits
        self._in_operation = False
        self._heartbeat_at_s: float | None = None
        self._beats: deque[float] = deque(maxlen=_DOUBLED_BEATS)
        self._passive_since_s: float | None = None
        self.state: int | None = None
        self.boot_ups = 0
        self.short_emergencies = 0
        self.error_frames = 0

    def enter_operation(self, now_s: float) -> None:
        """From now on the unit must be operational, and its heartbeat must not stop."""
        self._in_operation = True
        self._heartbeat_at_s = now_s

    def on_heartbeat(self, data: bytes, t_s: float) -> None:
        """Take a message of COB-ID 0x700 + node."""
        if len(data) != 1:
            return
        self.state = data[0] & 0x7F
        self._heartbeat_at_s = t_s
        if self.state == BOOT_UP:
            self.boot_ups += 1
            if self._in_operation:
                raise NodeRebooted(
                    f"{self._name} sent a boot-up message while in operation: it restarted, or a "
                    "second unit has the same node-ID; its set-up is gone, check its supply, then "
                    "start the link and tare again"
                )
        elif self._in_operation and self.state != OPERATIONAL:
            found = NMT_STATES.get(self.state, f"unknown state {self.state}")
            raise NodeStateChanged(
                f"{self._name} is {found}, expected operational: another NMT master, or an error "
                "in the unit (object 0x1029); start the link again"
            )
        elif self._in_operation:
            self._count_beat(t_s)

    def _count_beat(self, t_s: float) -> None:
        self._beats.append(t_s)
        limit_s = _DOUBLED_PERIODS * self._limits.heartbeat_s
        if len(self._beats) == _DOUBLED_BEATS and t_s - self._beats[0] < limit_s:
            raise DuplicateNode(
                f"{_DOUBLED_BEATS} heartbeats came from {self._name} within "
                f"{t_s - self._beats[0]:.2f} s, its period is {self._limits.heartbeat_s:g} s: a "
                "second unit has the same node-ID; leave one on the bus, then start the link again"
            )

    def on_emergency(self, data: bytes) -> None:
        """Take a message of COB-ID 0x080 + node."""
        emergency = decode_emergency(data)
        if emergency is None:
            self.short_emergencies += 1
        elif emergency.code != ERROR_RESET:
            raise NodeEmergency(emergency.code, emergency.register, emergency.text, self._name)

    def on_error_frame(self, classes: int, data: bytes | bytearray, t_s: float) -> None:
        """Take an error frame of the host's own CAN controller."""
        self.error_frames += 1
        if classes & _CLASS_BUS_OFF:
            raise BusOff(
                "the CAN controller of the host is bus-off: check wiring, termination and bit "
                "rate, restart the interface, then start the link again"
            )
        controller = data[1] if classes & _CLASS_CONTROLLER and len(data) > 1 else 0
        if controller & _ACTIVE or classes & _CLASS_RESTARTED:
            self._passive_since_s = None
        elif controller & _PASSIVE and self._passive_since_s is None:
            self._passive_since_s = t_s

    def check(self, now_s: float) -> None:
        """Look at the deadlines."""
        passive_since_s = self._passive_since_s
        if passive_since_s is not None and now_s - passive_since_s >= self._limits.passive_s:
            raise BusErrorPassive(
                f"the CAN controller of the host has been error-passive for "
                f"{now_s - passive_since_s:.2f} s, allowed are {self._limits.passive_s:g} s: check "
                "wiring, termination and bit rate, then start the link again"
            )
        if not self._in_operation or self._heartbeat_at_s is None:
            return
        limit_s = self._limits.heartbeat_factor * self._limits.heartbeat_s
        silent_s = now_s - self._heartbeat_at_s
        if silent_s > limit_s:
            raise HeartbeatLost(
                f"no heartbeat from {self._name} for {silent_s:.3f} s, allowed are {limit_s:g} s: "
                "check its supply and its CAN cable, then start the link again"
            )
