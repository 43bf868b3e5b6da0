"""Watch over the control unit: its state, its messages, and the host's CAN controller.

Time is an argument. canopen does not supervise: it has no heartbeat consumer, hides boot-ups
and drops error frames. Every method raises a `LinkFault` at once if its message is a fault.
"""

from collections import deque
from math import ceil, inf
from operator import itemgetter

from canopen.emcy import EMCY_STRUCT, EmcyError
from canopen.nmt import COMMAND_TO_STATE, NMT_COMMANDS, NMT_STATES

from tactile import errors
from tactile.can.bus import ACTIVE, CLASS_CONTROLLER, PASSIVE
from tactile.control_unit.settings import LinkSettings
from tactile.frames import COUNTERS, decode_force_message
from tactile.source import ForceMessage, ForceStatistics, ScanStatus, SourceStatistics

BOOT_UP = 0
"""State byte of a boot-up message (CiA 301, 7.2.8.3.3); canopen calls that state INITIALISING."""
OPERATIONAL = COMMAND_TO_STATE[NMT_COMMANDS["OPERATIONAL"]]
_STATE_BITS = 0x7F
"""Bits of the state in a heartbeat; the top bit is reserved."""

_EMERGENCY_TEXTS = {
    0xFF01: "a burst was cut short, it does not fit into the synchronous window",
    0xFF02: "a SYNC came while the burst before it was still being sent",
    0xFF03: "converter self-test failed",
    0xFF04: "multiplexer self-test failed",
}
"""The unit's own emergency codes; canopen has the groups of CiA 301, 7.2.7.1."""

_EMERGENCY_CODE_BYTES = 2
"""Length of the code at the start of an emergency message (CiA 301, 7.2.7)."""

_CLASS_BUS_OFF = 0x0040
_CLASS_RESTARTED = 0x0100
"""Further classes of error frames in SocketCAN's identifier (linux/can/error.h)."""

_BURST_S, _LEAST_BURST = 0.05, 10.0
"""Foreign or damaged messages allowed at once: those of this time in s, at least this number."""
_LATE_FORCES = 0.3
"""Allowed share of force messages that are older than the previous one. If all messages are sent
twice, it is at least a half."""
_STALL_SHOWS_S = 0.2
"""Time in s after a stall of the host in which force messages of the stall still count in
`ForceFlow.behind_s`, whose window is half of it."""
_USUAL_MESSAGES = 400
"""Number of messages whose least delay is the usual one: a unit's clock may have an error of a few
thousandths, so older ones do not count."""
_BEHIND_S, _LEAST_BEHIND = 0.1, 3
"""Time in s, and least number of messages, that must all come later than usual."""
_LAG_FRAMES = 500
"""Number of newest frames whose least lag is the usual one."""
_HEARTBEATS = 2.5
"""Number of periods after which the heartbeat is lost. One lost message is not a fault, and missing
frames show a dead unit earlier."""
_MAX_UNUSABLE_HZ = 20.0
"""Allowed rate of damaged or unusable messages in 1/s."""
_PASSIVE_S = 0.5
"""Longest time in s in which the host's CAN controller may be error-passive."""
_LOSS_FRAMES = 200
"""Number of newest frames for the share of lost ones. With 50, a loss of 1 % would often exceed the
usual limit of 5 % by chance."""
_UNANSWERED_SYNCS = 3
"""Number of SYNCs without a complete frame that is a fault."""
_LATE_PERIODS = 2
"""Delay of frames in periods, compared with before, that is a fault if it lasts."""
_LATE_SYNCS = 3
"""Number of successive SYNCs with late frames that counts: after a stall frames catch up."""
_SURPLUS_SHARE = 1.5
_SURPLUS_LIMIT = 0.9
_SURPLUS_SUSPECT = 0.4
_DEFICIT_LIMIT = 1.0
"""Limits in bursts. A sustained rate of one and a half bursts for each SYNC is allowed (an adapter
that sometimes doubles messages, a late burst). Two bursts each time are two units. Without complete
frames at the same time half of that is the limit."""


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
        Least allowed number of messages at once.
    """

    def __init__(self, what: str, advice: str, rate_hz: float, burst: float = _LEAST_BURST) -> None:
        self._what, self._advice = what, advice
        self._rate_hz, self._burst = rate_hz, max(burst, _BURST_S * rate_hz)
        self._total = self._n = 0
        self._level = self._at_s = self._since_s = 0.0

    def reach(self, total: int, t_s: float) -> None:
        """Add the messages up to a total at ``t_s`` s; BusDisturbed if they are too many."""
        n, self._total = total - self._total, total
        self._level = max(0.0, self._level - self._rate_hz * max(0.0, t_s - self._at_s))
        if self._level == 0.0:
            self._since_s, self._n = t_s, 0
        self._at_s = t_s
        self._level += n
        self._n += n
        if self._level > self._burst:
            raise errors.BusDisturbed(
                f"{self._n} {self._what} came within {1e3 * (t_s - self._since_s):.0f} ms, "
                f"allowed are {self._rate_hz:g} a second: {self._advice}, then start the link again"
            )


class NodeWatch:
    """Watch over one node: state, heartbeat, emergencies, useless messages, the host's controller.

    Its ``on_`` methods are handlers of messages for ``canopen.Network.subscribe``.
    """

    def __init__(self, name: str, settings: LinkSettings, counts: SourceStatistics) -> None:
        self._name, self._counts = name, counts
        self._silence_s = _HEARTBEATS * settings.heartbeat_s
        self._foreign_limit = TrafficLimit(
            "messages of other nodes or unknown COB-IDs",
            "find out who sends them, or raise tactile.foreign_max_hz where they belong there",
            settings.max_foreign_hz,
        )
        self._unusable_limit = TrafficLimit(
            "damaged messages", "check cable, termination, bit rate and adapter", _MAX_UNUSABLE_HZ
        )
        self._in_operation = False
        self._heartbeat_at_s, self._passive_since_s = -inf, inf
        self.state: int | None = None
        self.boot_ups = 0

    def enter_operation(self, now_s: float) -> None:
        """Require from now on that the unit is operational and sends its heartbeat."""
        self._in_operation = True
        self._heartbeat_at_s = now_s

    def wait_longer(self, late_s: float) -> None:
        """Extend all deadlines by a stall of the host in s."""
        self._heartbeat_at_s += late_s
        self._passive_since_s += late_s

    def on_foreign(self, t_s: float) -> None:
        """Process a message of another node."""
        self._counts.foreign += 1
        self._foreign_limit.reach(self._counts.foreign, t_s)

    def on_heartbeat(self, _cob_id: int, data: bytes | bytearray, t_s: float) -> None:
        """Process a message of COB-ID 0x700 + node; some units send a boot-up without data."""
        state = data[0] & _STATE_BITS if data else BOOT_UP
        if state != BOOT_UP and state not in NMT_STATES:
            # This state does not exist: a bit was flipped on the bus.
            self._counts.malformed += 1
            return
        self.state = state
        self._heartbeat_at_s = max(t_s, self._heartbeat_at_s)
        if self.state == BOOT_UP:
            self.boot_ups += 1
            if self._in_operation:
                raise errors.NodeRebooted(
                    f"{self._name} sent a boot-up message while in operation: it restarted, or a "
                    "second unit has the same node-ID; its set-up is gone, check its supply, then "
                    "start the link and tare again"
                )
        elif self._in_operation and self.state != OPERATIONAL:
            raise errors.NodeStateChanged(
                f"{self._name} is {NMT_STATES[state].lower()}, expected operational: check for "
                "another NMT master and an error of the unit (1029h), then start the link again"
            )

    def on_emergency(self, _cob_id: int, data: bytes | bytearray, _t_s: float) -> None:
        """Process a message of COB-ID 0x080 + node: code, error register, 5 more bytes (CiA 301).

        A shorter one with its code is an emergency, too: its sender has an error.
        """
        if len(data) < _EMERGENCY_CODE_BYTES:
            self._counts.malformed += 1
            return
        code, register, _ = EMCY_STRUCT.unpack(data.ljust(EMCY_STRUCT.size, b"\0"))
        if code:
            text = emergency_text(code)
            if len(data) < EMCY_STRUCT.size:
                text += f"; only {len(data)} of {EMCY_STRUCT.size} bytes arrived"
            raise errors.NodeEmergency(
                f"{self._name} reports emergency 0x{code:04X} ({text}), error register "
                f"0x{register:02X}: remove the cause, then start the link again"
            )

    def on_error_frame(self, classes: int, data: bytes | bytearray, t_s: float) -> None:
        """Process an error frame of the host's own CAN controller."""
        self._counts.error_frames += 1
        if classes & _CLASS_BUS_OFF:
            raise errors.BusOff(
                "the CAN controller of the host is bus-off: check wiring, termination and bit "
                "rate, restart the interface, then start the link again"
            )
        controller = data[1] if classes & CLASS_CONTROLLER and len(data) > 1 else 0
        if controller & ACTIVE or classes & _CLASS_RESTARTED:
            self._passive_since_s = inf
        elif controller & PASSIVE:
            self._passive_since_s = min(self._passive_since_s, t_s)

    def check(self, now_s: float, unusable: int) -> None:
        """Raise the fault of a missed deadline, or of too many unusable messages in total."""
        self._unusable_limit.reach(unusable, now_s)
        passive_s = now_s - self._passive_since_s
        if passive_s >= _PASSIVE_S:
            raise errors.BusErrorPassive(
                f"the CAN controller of the host has been error-passive for {passive_s:.2f} s, "
                f"allowed are {_PASSIVE_S:g} s: check wiring, termination and bit rate, then start "
                "the link again"
            )
        silent_s = now_s - self._heartbeat_at_s
        if self._in_operation and silent_s > self._silence_s:
            raise errors.HeartbeatLost(
                f"no heartbeat from {self._name} for {silent_s:.3f} s, allowed are "
                f"{self._silence_s:g} s: check its supply and its CAN cable, then start the link "
                "again"
            )


class FrameFlow:
    """Supervision of unanswered SYNCs, lost frames, late frames and double messages.

    Parameters
    ----------
    burst_messages
        Messages of one unit after each SYNC.
    """

    def __init__(self, name: str, settings: LinkSettings, burst_messages: int) -> None:
        self._name = name
        allowed = ceil(settings.silence_s / settings.sync_period_s)
        self._timeout_periods = max(_UNANSWERED_SYNCS, allowed)
        self._late_periods = max(_LATE_PERIODS, allowed)
        self._max_loss_rate = settings.max_loss_rate
        self._burst_messages = burst_messages
        self._arrived: deque[bool] = deque(maxlen=_LOSS_FRAMES)
        self._lost = 0
        self._unanswered = 0
        self._ahead = 0
        """SYNCs sent, less the scans of the unit's counter since its first frame."""
        self._lags: deque[int] = deque(maxlen=_LAG_FRAMES)
        self._late_syncs = 0
        self.messages = 0
        """Frame messages since the last SYNC."""
        self._surplus = 0.0

    @property
    def recent_loss_rate(self) -> float:
        """Share of frames lost in the window, 0 to 1."""
        return self._arrived.count(False) / len(self._arrived) if self._arrived else 0.0

    def before_sync(self) -> None:
        """Check the answers to the SYNCs so far; call it when the next SYNC is due.

        Raises FrameTimeout for too many SYNCs without an answer or with late ones, DuplicateNode
        for two answers.
        """
        n, self.messages = self.messages, 0
        late = max(0, self._ahead - min(self._lags, default=0))
        surplus = self._surplus + n / self._burst_messages - _SURPLUS_SHARE
        # Late messages will arrive all at once.
        self._surplus = max(surplus, -_DEFICIT_LIMIT - _SURPLUS_SHARE * late)
        out = self._unanswered >= self._timeout_periods
        if self._surplus > (_SURPLUS_SUSPECT if out else _SURPLUS_LIMIT):
            raise errors.DuplicateNode(
                f"{n} frame messages came after one SYNC, {self._name} sends "
                f"{self._burst_messages}: a second unit has the same node-ID, or the adapter "
                "doubles messages; leave one unit on the bus, then start the link again"
            )
        if out:
            raise errors.FrameTimeout(
                f"no whole frame from {self._name} after {self._unanswered} SYNCs: check bus "
                "load, cable and the unit's mode, then start the link again"
            )
        self._late_syncs = self._late_syncs + 1 if self._lags and late >= self._late_periods else 0
        if self._late_syncs >= _LATE_SYNCS:
            raise errors.FrameTimeout(
                f"the frames of {self._name} come {late} periods later than before, allowed are "
                f"{self._late_periods - 1}: the adapter or the host delays messages, or SYNCs do "
                "not reach the unit; check both, then start the link again"
            )
        self._unanswered += 1
        self._ahead += 1

    def on_frame(self, lost: int) -> None:
        """Add a complete frame; FrameTimeout if too many were lost: so many in all."""
        self._unanswered = 0
        missing, self._lost = lost - self._lost, lost
        self._arrived.extend([False] * min(missing, _LOSS_FRAMES))
        self._arrived.append(True)
        self._ahead -= 1 + missing
        lost_frames = self._arrived.count(False)
        if lost_frames > self._max_loss_rate * _LOSS_FRAMES:
            raise errors.FrameTimeout(
                f"{lost_frames} of the last {_LOSS_FRAMES} frames from {self._name} were "
                f"lost, allowed are {self._max_loss_rate:.0%}: check bus load, cable and "
                "termination, then start the link again"
            )
        self._lags.append(self._ahead)


class ForceFlow:
    """Force messages: each is returned once, none after a newer one; few lost, late or silent."""

    def __init__(self, name: str, settings: LinkSettings, counts: ForceStatistics) -> None:
        self._name, self._settings = name, settings
        self.counts = counts
        """Counts so far; they are updated."""
        self._period_s = settings.force_period_s
        rate_hz, burst = 1.0 / settings.force_period_s, settings.force_timeout_s
        self._lost = TrafficLimit(
            "lost force messages",
            "check bus load, cable and termination",
            settings.max_loss_rate * rate_hz,
            burst * rate_hz,
        )
        self._late = TrafficLimit(
            "force messages that are older than the one before",
            "look for a gateway or a second unit that sends old messages again",
            _LATE_FORCES * rate_hz,
            burst * rate_hz,
        )
        self._last_s, self._stalled_s, self._stall_s = -inf, -inf, 0.0
        self._last_counter, self._last_data = 0, b""
        self._came_s = 0.0
        self._sent = 0
        self._delays: deque[tuple[float, float]] = deque()
        self._usual_delays: deque[float] = deque(maxlen=_USUAL_MESSAGES)

    def enter_operation(self, now_s: float) -> None:
        """Require force messages from now on."""
        self._last_s = now_s

    def wait_longer(self, now_s: float, late_s: float) -> None:
        """Extend all deadlines by a stall of the host in s that ends now."""
        self._last_s += late_s
        self._stalled_s, self._stall_s = now_s, self._settings.sync_period_s + late_s

    def push(self, data: bytes | bytearray, t_s: float) -> ForceMessage | None:
        """Add a message received at ``t_s`` s and return it if it is valid and newer."""
        message = decode_force_message(data, t_s)
        if message is None:
            self.counts.damaged += 1
            return None
        # Silence since any message: a repeated message never counts as a new one.
        silence_s, self._came_s = t_s - self._came_s, t_s
        if self._last_data and not self._follows(message.counter, data, silence_s):
            return None
        self._note_delay(message)
        self._last_counter, self._last_data = message.counter, bytes(data)
        self._last_s = max(self._last_s, t_s)
        self.counts.received += 1
        return message

    @property
    def behind_s(self) -> float:
        """Additional delay in s of all messages of the last 0.1 s, compared with the usual one.

        It follows from their counters. Messages that are sent less often also get a delay, and so
        do messages after a loss of sixteen at once.
        """
        if not self._usual_delays:
            return 0.0
        return min(self._delays, key=itemgetter(1))[1] - min(self._usual_delays)

    def _note_delay(self, message: ForceMessage) -> None:
        """Add the delay of a message after the time at which its counter was due."""
        step = (message.counter - self._last_counter) % COUNTERS if self._last_data else 1
        self._sent += step + (ScanStatus.OVERRUN in message.status)
        self._delays.append((message.t_s, message.t_s - self._sent * self._period_s))
        while message.t_s - self._delays[0][0] > _BEHIND_S and len(self._delays) > _LEAST_BEHIND:
            # The usual delay excludes the messages that may be late.
            self._usual_delays.append(self._delays.popleft()[1])

    def _follows(self, counter: int, data: bytes | bytearray, silence_s: float) -> bool:
        step = (counter - self._last_counter) % COUNTERS
        if round(silence_s / self._period_s) < COUNTERS // 2:
            if data == self._last_data:
                self.counts.repeated += 1
                return False
            if step == 0 or step >= COUNTERS // 2:
                self.counts.late += 1
                # It was counted as lost when the newer one came.
                self.counts.lost = max(0, self.counts.lost - 1)
                return False
        # After a silence at least this number is missing; the host may only have polled late.
        self.counts.lost += (step - 1) % COUNTERS
        return True

    def too_late(self, late_s: float) -> errors.FrameTimeout:
        """Return the error of force messages that are late by a time in s."""
        return errors.FrameTimeout(
            f"the force messages of {self._name} come {1e3 * late_s:.0f} ms late, allowed are "
            f"{1e3 * self._settings.force_late_s:.0f} ms: the unit sends them later or more "
            "seldom than it was set to, or many were lost at once; check its firmware and the bus "
            "load, then start the link again"
        )

    def check(self, now_s: float) -> None:
        """Raise BusDisturbed for too many lost or old messages, FrameTimeout for late or none."""
        self._lost.reach(self.counts.lost, now_s)
        self._late.reach(self.counts.late, now_s)
        # Messages of a stall of the host were read at its end, and look late for a while.
        excuse_s = self._stall_s if now_s - self._stalled_s < _STALL_SHOWS_S else 0.0
        if self.behind_s - excuse_s > self._settings.force_late_s:
            raise self.too_late(self.behind_s)
        silent_s, limit_s = now_s - self._last_s, self._settings.force_timeout_s
        if silent_s > limit_s:
            raise errors.FrameTimeout(
                f"no force message from {self._name} for {1e3 * silent_s:.0f} ms, allowed are "
                f"{1e3 * limit_s:.0f} ms: check that the control unit has power, its cable and the "
                "bus load, then start the link again"
            )
