"""The session of a link, from one start to its end: messages, SYNC, supervision, statistics."""

from collections.abc import Callable
from dataclasses import replace
from math import ceil, inf

import can
import canopen
from canopen.nmt import NMT_COMMANDS

from tactile.can.bus import bad_lines
from tactile.can.receiver import MessageSource, interface_failed, of_another_kind
from tactile.can.sdo_client import PolledSdoClient
from tactile.clock import Clock
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.sdo import ObjectAccess
from tactile.control_unit.settings import LinkSettings
from tactile.control_unit.supervision import NodeSupervisor, TrafficLimit
from tactile.errors import DuplicateNode, FrameTimeout, NodeMissing
from tactile.frames.assembler import FrameAssembler
from tactile.frames.codec import FrameFormat
from tactile.frames.flow import FrameFlow
from tactile.frames.force_stream import ForceStream
from tactile.layout import TaxelLayout
from tactile.source import Arrivals, ForceMessage, ForceStatistics, SourceStatistics, TactileFrame

_SURPLUS_ANSWERS = 3
"""Surplus of SDO answers over requests that shows a second unit, not one double message."""
_BURST_S, _LEAST_BURST = 0.05, 10.0
"""Foreign or damaged messages allowed at once: those of this time in s, at least this number."""
_LATE_FORCES = 0.3
"""Allowed share of force messages that are older than the previous one. If all messages are sent
twice, it is at least a half."""
_LEAST_GAP = 0.9
"""Least pause after a late SYNC in periods, so that the next one does not cut into the burst."""
_STALL_SHOWS_S = 0.2
"""Time in s after a stall of the host in which force messages of the stall still count in
`ForceStream.behind_s`, whose window is half of it."""
_SYNC_EARLY_S = 1e-6
"""Tolerance in s for a caller that polls in step with SYNC, because of rounding errors."""


class LinkSession:
    """One control unit from the start of the link to its end.

    Parameters
    ----------
    source
        Source of its messages; already started.
    """

    def __init__(
        self,
        bus: can.BusABC,
        source: MessageSource,
        *,
        node_id: int,
        layout: TaxelLayout,
        clock: Clock,
        settings: LinkSettings,
    ) -> None:
        self.name = f"the control unit (node-ID {node_id})"
        self._source = source
        self._node_id = node_id
        self._clock = clock
        self._settings = settings
        self._bus = bus
        self._network = canopen.Network(bus)
        self._client = PolledSdoClient(
            node_id=node_id,
            dictionary=od.of_node(node_id),
            clock=clock,
            service=self.service,
            wait=source.wait,
            timeout_s=settings.sdo_timeout_s,
        )
        self._client.network = self._network
        self.objects = ObjectAccess(self._client, name=self.name)
        self.supervisor = NodeSupervisor(
            self.name,
            heartbeat_s=settings.heartbeat_s,
            heartbeat_factor=settings.heartbeat_factor,
            passive_s=settings.error_passive_s,
        )
        frame_format = FrameFormat.of(layout)
        self._assembler = FrameAssembler(frame_format)
        self._flow = _flow(self.name, settings, frame_format)
        self._foreign_limit = _limit(
            "messages of other nodes or unknown COB-IDs",
            "find out who sends them, or raise tactile.foreign_max_hz where they belong there",
            settings.max_foreign_hz,
        )
        self._malformed_limit = _limit(
            "damaged messages",
            "check cable, termination, bit rate and adapter",
            settings.max_malformed_hz,
        )
        rate_hz = 1.0 / settings.force_period_s if settings.force_period_s else inf
        self._lost_forces = TrafficLimit(
            "lost force messages",
            "check bus load, cable and termination",
            rate_hz=settings.max_loss_rate * rate_hz,
            burst=settings.force_timeout_s * rate_hz,
        )
        self._late_forces = TrafficLimit(
            "force messages that are older than the one before",
            "look for a gateway or a second unit that sends old messages again",
            rate_hz=_LATE_FORCES * rate_hz,
            burst=settings.force_timeout_s * rate_hz,
        )
        self._forces: ForceStream | None = None
        self._new_forces: list[ForceMessage] = []
        self._force_s = self._looked_s = 0.0
        self._stalled_s, self._stall_s = -inf, 0.0
        self._frame_id = od.COB_TPDO1 + node_id
        self._frames: list[TactileFrame] = []
        self._nodes_heard: set[int] = set()
        self._next_sync_s: float | None = None
        self._syncs = self._late_syncs = self._foreign = self._malformed = 0
        self._bad_lines = bad_lines(bus)
        self._unusable = 0
        answers = od.COB_SDO_RESPONSE + node_id
        self._handlers: dict[int, Callable[[bytes, float], None]] = {
            od.COB_EMCY + node_id: lambda data, _t_s: self.supervisor.on_emergency(data),
            answers: lambda data, t_s: self._client.on_response(answers, data, t_s),
            od.COB_HEARTBEAT + node_id: self.supervisor.on_heartbeat,
        }

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the start."""
        return SourceStatistics(
            frames=replace(self._assembler.counts),
            forces=ForceStatistics() if self._forces is None else replace(self._forces.counts),
            recent_loss_rate=self._flow.recent_loss_rate,
            foreign=self._foreign,
            malformed=self._unusable_now(),
            error_frames=self.supervisor.error_frames,
            requests=self._syncs,
            late_requests=self._late_syncs,
        )

    def take(self) -> Arrivals:
        """Return frames and force messages since the last call, in the order of the unit."""
        arrived = Arrivals(tuple(self._frames), tuple(self._new_forces))
        self._frames.clear()
        self._new_forces.clear()
        return arrived

    def drop_forces(self) -> tuple[ForceMessage, ...]:
        """Remove the waiting force messages from the next arrivals, and return them."""
        forces = tuple(self._new_forces)
        self._new_forces.clear()
        return forces

    def expect_forces(self, frame_id: int) -> None:
        """Accept force messages from now on, and the frames with another COB-ID."""
        self._forces = ForceStream(self._settings.force_period_s)
        self._frame_id = frame_id
        self._handlers[od.COB_TPDO2 + self._node_id] = self._on_force

    @property
    def sends_forces(self) -> bool:
        """Whether the unit was set up to send force messages."""
        return self._forces is not None

    def enter_operation(self) -> None:
        """Send SYNC from now on, and supervise heartbeat, state, frames and force messages."""
        now_s = self._force_s = self._looked_s = self._clock.monotonic()
        self.supervisor.enter_operation(now_s)
        self._next_sync_s = now_s

    def leave_operation(self) -> None:
        """Stop SYNC."""
        self._next_sync_s = None

    def command(self, name: str) -> None:
        """Send an NMT command to the unit, by its name in ``canopen.nmt.NMT_COMMANDS``."""
        self._send(od.COB_NMT, bytes((NMT_COMMANDS[name], self._node_id)))

    def service(self) -> None:
        """Process received messages, check the deadlines, send SYNC when due.

        If the time since the last call exceeds a period of SYNC, the host is late. All deadlines
        are then extended by this lateness.
        """
        late_s = self._clock.monotonic() - self._looked_s - self._settings.sync_period_s
        if self._next_sync_s is not None and late_s > 0.0:
            self._stalled_s = self._looked_s + self._settings.sync_period_s + late_s
            self._stall_s = self._settings.sync_period_s + late_s
            self._force_s += late_s
            self.supervisor.wait_longer(late_s)
        frame_id = self._frame_id
        push = self._assembler.push
        n_frame_messages = 0
        for t_s, message in self._source.drain():
            if message.is_error_frame:
                self.supervisor.on_error_frame(message.arbitration_id, message.data, t_s)
            elif of_another_kind(message):
                self._add_foreign(t_s)
            elif message.arbitration_id == frame_id:
                n_frame_messages += 1
                frame = push(message.data, message.dlc, t_s)
                if frame is not None:
                    self._frames.append(frame)
                    self._flow.on_frame(frame.counter)
            else:
                self._dispatch(message, t_s)
        self._flow.messages(n_frame_messages)
        now_s = self._looked_s = self._clock.monotonic()
        self._check_unusable(now_s)
        if self._next_sync_s is None:
            self._check_answers()
        self.supervisor.check(now_s)
        if self._forces is not None and self._next_sync_s is not None:
            self._check_forces(now_s)
        if self._next_sync_s is not None and now_s >= self._next_sync_s - _SYNC_EARLY_S:
            self._sync(now_s, self._next_sync_s)

    def wait_for(self, condition: Callable[[], bool], failure: str) -> None:
        """Service until a condition holds; NodeMissing with ``failure`` after the start-up time."""
        timeout_s = self._settings.startup_timeout_s
        deadline_s = self._clock.monotonic() + timeout_s
        self.service()
        while not condition():
            left_s = deadline_s - self._clock.monotonic()
            if left_s <= 0.0:
                heard = ", ".join(str(node) for node in sorted(self._nodes_heard))
                found = f"node-IDs heard: {heard}" if heard else "no node is heard on this bus"
                raise NodeMissing(
                    f"{self.name} {failure} within {timeout_s:g} s; {found}. Check the unit's "
                    "supply, node-ID, bit rate, CAN cable and termination"
                )
            self._source.wait(left_s)
            self.service()

    def _send(self, cob_id: int, data: bytes) -> None:
        try:
            self._network.send_message(cob_id, data)
        except (can.CanError, OSError) as error:
            raise interface_failed(error) from error

    def _dispatch(self, message: can.Message, t_s: float) -> None:
        cob_id = message.arbitration_id
        if cob_id & od.FUNCTION_BITS == od.COB_HEARTBEAT:
            self._nodes_heard.add(cob_id & od.NODE_BITS)
        handler = self._handlers.get(cob_id)
        if handler is None:
            self._add_foreign(t_s)
        elif len(message.data) != message.dlc:
            self._malformed += 1
        else:
            handler(bytes(message.data), t_s)

    def _add_foreign(self, t_s: float) -> None:
        self._foreign += 1
        self._foreign_limit.add(t_s)

    def _unusable_now(self) -> int:
        """Return the number of unusable messages without damaged frame messages."""
        return self._malformed + self.supervisor.unusable + bad_lines(self._bus) - self._bad_lines

    def _check_unusable(self, now_s: float) -> None:
        unusable = self._unusable_now() + self._assembler.counts.short
        if unusable > self._unusable:
            new, self._unusable = unusable - self._unusable, unusable
            self._malformed_limit.add(now_s, new)

    def _check_answers(self) -> None:
        """Raise DuplicateNode if there were more answers than requests."""
        if self._client.surplus >= _SURPLUS_ANSWERS:
            raise DuplicateNode(
                f"{self._client.surplus} SDO answers more came from {self.name} than were asked "
                "for: a second unit has the same node-ID, or another program talks to the unit; "
                "leave one of them on the bus, then start the link again"
            )

    def _sync(self, now_s: float, due_s: float) -> None:
        self._flow.before_sync()
        self._send(od.COB_SYNC, b"")
        self._syncs += 1
        period_s = self._settings.sync_period_s
        if now_s - due_s >= period_s:
            self._late_syncs += 1
            due_s = now_s
        self._next_sync_s = max(due_s + period_s, now_s + _LEAST_GAP * period_s)

    def _on_force(self, data: bytes, t_s: float) -> None:
        assert self._forces is not None
        counts = self._forces.counts
        lost, late = counts.lost, counts.late
        message = self._forces.push(data, t_s)
        if message is not None:
            self._new_forces.append(message)
            self._force_s = max(self._force_s, t_s)
        self._lost_forces.add(t_s, counts.lost - lost)
        self._late_forces.add(t_s, counts.late - late)

    def forces_late(self, late_s: float) -> FrameTimeout:
        """Return the error of force messages that are late by a time in s."""
        return FrameTimeout(
            f"the force messages of {self.name} come {1e3 * late_s:.0f} ms late, allowed are "
            f"{1e3 * self._settings.force_late_s:.0f} ms: the unit sends them later or more "
            "seldom than it was set to, or many were lost at once; check its firmware and the bus "
            "load, then start the link again"
        )

    def _check_forces(self, now_s: float) -> None:
        """Raise FrameTimeout for late or missing force messages."""
        assert self._forces is not None
        # Messages of a stall of the host were read at its end, and look late for a while.
        excuse_s = self._stall_s if now_s - self._stalled_s < _STALL_SHOWS_S else 0.0
        if self._forces.behind_s - excuse_s > self._settings.force_late_s:
            raise self.forces_late(self._forces.behind_s)
        silent_s = now_s - self._force_s
        limit_s = self._settings.force_timeout_s
        if silent_s > limit_s:
            raise FrameTimeout(
                f"no force message from {self.name} for {1e3 * silent_s:.0f} ms, allowed are "
                f"{1e3 * limit_s:.0f} ms: check that the control unit has power, its cable and the "
                "bus load, then start the link again"
            )


def _flow(name: str, settings: LinkSettings, frame_format: FrameFormat) -> FrameFlow:
    allowed = ceil(settings.silence_s / settings.sync_period_s)
    return FrameFlow(
        name,
        timeout_periods=max(settings.frame_timeout_periods, allowed),
        max_loss_rate=settings.max_loss_rate,
        window_frames=settings.loss_window_frames,
        late_periods=max(settings.late_periods, allowed),
        burst_messages=frame_format.n_messages,
    )


def _limit(what: str, advice: str, rate_hz: float) -> TrafficLimit:
    burst = max(_LEAST_BURST, _BURST_S * rate_hz)
    return TrafficLimit(what, advice, rate_hz=rate_hz, burst=burst)
