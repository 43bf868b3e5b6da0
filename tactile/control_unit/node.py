"""The control unit as a CANopen node: starts it, and returns complete frames or a fault.

canopen dispatches the messages and transfers objects. Its notifier, and its consumers of heartbeats
and emergencies, are not used: an exception there is one log line, and they fail on short messages
and unknown states, which some units send.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import can
import canopen
import numpy as np
from canopen.nmt import NMT_COMMANDS

from tactile import errors
from tactile.can.bus import bad_lines, interface_failed, message_source, of_another_kind, reopened
from tactile.can.sdo_client import PolledSdoClient
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.settings import LinkSettings
from tactile.control_unit.setup import refuse_mismatch, refuse_other_unit, set_up
from tactile.control_unit.watch import OPERATIONAL, ForceFlow, FrameFlow, NodeWatch
from tactile.frames import ForceLaw, FrameAssembler, FrameFormat, encode_zero, force_table
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.source import (
    Arrivals,
    ForceMessage,
    LatchingSource,
    PadZero,
    ScanStatus,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)

_TRIPS = 10
"""Number of answers; one of them must come in time. A busy host may delay some."""
_SURPLUS_ANSWERS = 3
"""Surplus of SDO answers over requests that shows a second unit, not one double message."""
_LEAST_GAP = 0.9
"""Least pause after a late SYNC in periods, so that the next one does not cut into the burst."""
_SYNC_EARLY_S = 1e-6
"""Tolerance in s for a caller that polls in step with SYNC, because of rounding errors."""


class UnitNetwork(canopen.Network):
    """The unit's CAN bus, for the link and its transfers."""

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a message. Raises BusOff when the interface fails."""
        try:
            super().send_message(can_id, data, remote)
        except (can.CanError, OSError) as error:
            raise interface_failed(error) from error


class Mounting:
    """Converts the order of the control unit's pads to that of the layout, and back.

    Raises LayoutError as `tactile.layout.taxel_order`.

    Parameters
    ----------
    layout
        The taxels.
    mounts
        Pads with another mounting than in the layout.
    """

    def __init__(self, layout: TaxelLayout, mounts: Sequence[PadMount]) -> None:
        self.order = taxel_order(layout, mounts)
        """(n_taxels,) int64: place of each taxel of the layout in the unit's frames."""
        gripping = layout.gripping_pads
        by_pad = {mount.pad: mount for mount in mounts}
        first, second = (by_pad.get(pad, PadMount(pad=pad, sent_as=pad)) for pad in gripping)
        self.exchanged = (first.sent_as, second.sent_as) == gripping[::-1]
        """Whether each gripping pad has the place of the other one."""
        turns = {(mount.rows_mirrored, mount.columns_mirrored) for mount in (first, second)}
        self.unit_can_sum = {first.sent_as, second.sent_as} == set(gripping) and len(turns) == 1
        """Whether the unit's force messages are valid. It sums its own two gripping pads and sends
        one centre for both."""
        self._signs = (-1 if first.rows_mirrored else 1, -1 if first.columns_mirrored else 1)
        own = np.r_[layout.gripping_taxels]
        place = np.empty(layout.n_taxels, dtype=np.int64)
        place[own] = np.arange(len(own))
        self.zero_order = place[np.argsort(self.order)[own]]
        """(n,) int64: for each taxel that the unit sums its place on the layout's gripping pads."""

    def force(self, message: ForceMessage) -> ForceMessage:
        """Return a force message of the unit with the forces of the layout's fingers."""
        first_n, second_n = message.force_n
        centre = message.centre_taxels
        along, across = self._signs
        return replace(
            message,
            force_n=(second_n, first_n) if self.exchanged else message.force_n,
            centre_taxels=None if centre is None else (along * centre[0], across * centre[1]),
        )


class TactileLink(LatchingSource):
    """One control unit on one CAN bus; implements `tactile.source.FrameSource`.

    `start`, then call `poll` often: it processes received messages, sends SYNC when due and checks
    all deadlines, in the caller's thread. A fault is raised at once and again by every later call
    until `stop` and `start`. The caller owns the bus: `stop` leaves it open.

    Parameters
    ----------
    bus
        An open bus.
    node_id
        CANopen node-ID of the unit, 1 to 127.
    force_law
        Law of the taxels for the unit's sum of the force; None: no force messages.
    reopen
        Opens a lost bus again; without it a lost bus stays lost.
    """

    def __init__(
        self,
        bus: can.BusABC,
        *,
        node_id: int,
        layout: TaxelLayout,
        settings: LinkSettings | None = None,
        force_law: ForceLaw | None = None,
        reopen: Callable[[], can.BusABC] | None = None,
    ) -> None:
        super().__init__()
        if not 1 <= node_id <= 127:
            raise ValueError(f"node-ID is {node_id}, must be 1 to 127")
        self._name = f"the control unit (node-ID {node_id})"
        self._bus, self._reopen, self._node_id = bus, reopen, node_id
        self.layout = layout
        """The taxels of the unit."""
        self.settings = settings or LinkSettings()
        """Periods and limits."""
        self._mounting = Mounting(layout, self.settings.mounts)
        # The unit's sums are valid only for the gripping pads in their mounting.
        sums = self.settings.force_period_s and self._mounting.unit_can_sum
        self._force_table: bytes | None = None
        if sums and force_law is not None:
            self._force_table = force_table(layout, force_law, exchanged=self._mounting.exchanged)
        self._reset()

    def _reset(self) -> None:
        """Forget the unit: what was received, counted and set up since a start."""
        node_id = self._node_id
        self._source = message_source(self._bus)
        self.clock = self._source.clock
        """The clock of the bus."""
        self._network = UnitNetwork(self._bus)
        self._network.unsubscribe(self._network.lss.LSS_RX_COBID)
        self.objects = PolledSdoClient(
            node_id,
            od.of_node(node_id),
            name=self._name,
            clock=self.clock,
            service=self._service,
            wait=self._source.wait,
            timeout_s=self.settings.sdo_timeout_s,
        )
        """Reads and writes the unit's objects."""
        self.objects.network = self._network
        frame_format = FrameFormat.of(self.layout)
        self._assembler = FrameAssembler(frame_format, self._mounting.order)
        self._counts = SourceStatistics(frames=self._assembler.counts)
        self._watch = NodeWatch(self._name, self.settings, self._counts)
        self._flow = FrameFlow(self._name, self.settings, frame_format.n_messages)
        self._force_flow: ForceFlow | None = None
        self._frames: list[TactileFrame] = []
        self._new_forces: list[ForceMessage] = []
        self._looked_s = 0.0
        self._next_sync_s: float | None = None
        self._bad_lines = bad_lines(self._bus)
        for cob_id, handler in (
            (od.COB_TPDO1 + node_id, self._on_frame),
            (od.COB_EMCY + node_id, self._watch.on_emergency),
            (self.objects.tx_cobid, self.objects.on_response),
            (od.COB_HEARTBEAT + node_id, self._watch.on_heartbeat),
        ):
            self._network.subscribe(cob_id, handler)

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the last start."""
        return self._counts.copied(
            recent_loss_rate=self._flow.recent_loss_rate, malformed=self._unusable
        )

    @property
    def _unusable(self) -> int:
        """Number of unusable messages without frame messages of a wrong length."""
        return self._counts.malformed + bad_lines(self._bus) - self._bad_lines

    def start(self) -> SourceIdentity:
        """Reset the unit's communication, check it, set it up and start its frames.

        Returns its identity when it is operational. Raises NodeMissing if it does not boot in time,
        IdentityMismatch for another unit, and any other LinkFault. Allowed again after `stop`,
        which clears a latched fault.
        """
        if self._running:
            raise errors.LinkStateError("the link runs already: stop it before starting again")
        self._bus = reopened(self._bus, self.fault, self._reopen)
        self._running = True
        self.fault = None
        self._reset()
        return self._guarded(self._commission)

    @contextmanager
    def reading(self) -> Iterator[PolledSdoClient]:
        """Give access to the objects of a unit, whatever it is, without a start."""
        self._source.start()
        try:
            yield self.objects
        finally:
            self._source.close()

    def _commission(self) -> SourceIdentity:
        objects, watch, settings = self.objects, self._watch, self.settings
        self._source.start()
        self._command("RESET COMMUNICATION")
        self._wait_for(lambda: watch.boot_ups > 0, "did not boot")
        identity = refuse_other_unit(objects, self.layout, self._node_id, settings)
        table = self._force_table if self._answers_in_time() else None
        set_up(objects, settings, self._node_id, table)
        if table is not None:
            self._force_flow = ForceFlow(self._name, settings, self._counts.forces)
            self._network.unsubscribe(od.COB_TPDO1 + self._node_id)
            self._network.subscribe(od.COB_TPDO3 + self._node_id, self._on_frame)
            self._network.subscribe(od.COB_TPDO2 + self._node_id, self._on_force)
        if watch.boot_ups > 1:
            raise errors.NodeMissing(
                f"{self._name} booted {watch.boot_ups} times while it was set up: its "
                "supply is unstable, or two units have the same node-ID"
            )
        self._command("OPERATIONAL")
        self._wait_for(lambda: watch.state == OPERATIONAL, "did not become operational")
        # From now on SYNC is sent, and heartbeat, state, frames and force messages are supervised.
        now_s = self._looked_s = self._next_sync_s = self.clock.monotonic()
        watch.enter_operation(now_s)
        if self._force_flow is not None:
            self._force_flow.enter_operation(now_s)
        self._service()
        return replace(identity, sends_forces=self._force_flow is not None)

    def _answers_in_time(self) -> bool:
        """Return whether the unit has force messages; FrameTimeout if its answers come too late."""
        limit_s = self.settings.force_late_s
        for _ in range(_TRIPS):
            asked_s = self.clock.monotonic()
            has_forces = self.objects.find(od.FORCE_MESSAGE) is not None
            trip_s = self.clock.monotonic() - asked_s
            if self._force_table is None or not has_forces or trip_s <= limit_s:
                return has_forces
        raise errors.FrameTimeout(
            f"{self._name} answers after {1e3 * trip_s:.0f} ms, allowed for its force messages are "
            f"{1e3 * limit_s:.0f} ms: a gateway or the latency timer of the CAN adapter delays "
            "them. Use a direct adapter, set its timer to 1 ms, then start the link again"
        )

    def poll(self) -> Arrivals:
        """Return the complete frames and force messages since the last call; does not wait."""
        self._guarded(self._service)
        frames = tuple(self._frames)
        self._frames.clear()
        return Arrivals(frames, self._take_forces())

    def set_zero(self, zero: PadZero) -> None:
        """Write object 0x2142, the zero of the force messages, and read it back.

        Does nothing if the unit sends none. Raises IdentityMismatch if the unit did not store it,
        and FrameTimeout if messages from before the write still come after it. Takes tens of ms;
        the messages of that time are dropped.
        """
        flow = self._force_flow
        if flow is None:
            return
        order, adc_max = self._mounting.zero_order, self.layout.adc_max
        sent = encode_zero(zero.touch_counts, zero.offset_counts[order], zero.bad[order], adc_max)

        def write() -> None:
            self.objects[od.FORCE_ZERO].raw = sent
            written_s = self.clock.monotonic()
            self._take_forces()
            stored = self.objects[od.FORCE_ZERO].raw
            later = self._take_forces()
            old_s = [message.t_s for message in later if not message.status & ScanStatus.ZEROED]
            # The last scan before the zero was half a period earlier, on average. A busy host may
            # read one message late.
            late_s = max(old_s, default=written_s) - written_s + 0.5 * self.settings.force_period_s
            if len(old_s) > 1 and late_s > self.settings.force_late_s:
                raise flow.too_late(late_s)
            zeros = ("zero of the force", sent.hex(), stored.hex())
            refuse_mismatch([zeros], f"{self._name} did not keep its zero")
            self._take_forces()

        self._guarded(write)

    def stop(self) -> None:
        """Stop the frames and the receiver; does not raise on a dead bus, leaves the bus open."""
        if self._running:
            self._running = False
            self._next_sync_s = None
            try:
                self._command("PRE-OPERATIONAL")
            except errors.LinkFault as fault:
                # The command does not reach the unit; its frames end without SYNCs.
                self.fault = fault
        self._source.close()

    def _take_forces(self) -> tuple[ForceMessage, ...]:
        """Return the force messages since the last call."""
        forces = tuple(self._new_forces)
        self._new_forces.clear()
        return forces

    def _command(self, name: str) -> None:
        """Send an NMT command to the unit, by its name in ``canopen.nmt.NMT_COMMANDS``."""
        self._network.send_message(od.COB_NMT, bytes((NMT_COMMANDS[name], self._node_id)))

    def _service(self) -> None:
        """Process received messages, check the deadlines, send SYNC when due.

        If the time since the last call exceeds a period of SYNC, the host is late. All deadlines
        are then extended by this lateness.
        """
        now_s = self.clock.monotonic()
        late_s = now_s - self._looked_s - self.settings.sync_period_s
        operating, forces = self._next_sync_s is not None, self._force_flow
        if operating and late_s > 0.0:
            self._watch.wait_longer(late_s)
            if forces is not None:
                forces.wait_longer(now_s, late_s)
        self._dispatch()
        now_s = self._looked_s = self.clock.monotonic()
        self._watch.check(now_s, self._unusable + self._assembler.counts.short)
        if self._next_sync_s is None:
            surplus = self.objects.surplus
            if surplus >= _SURPLUS_ANSWERS:
                raise errors.DuplicateNode(
                    f"{surplus} SDO answers more came from {self._name} than were asked for: a "
                    "second unit has the same node-ID, or another program talks to the unit; "
                    "leave one of them on the bus, then start the link again"
                )
            return
        if forces is not None:
            forces.check(now_s)
        if now_s >= self._next_sync_s - _SYNC_EARLY_S:
            self._sync(now_s, self._next_sync_s)

    def _wait_for(self, condition: Callable[[], bool], failure: str) -> None:
        """Service until a condition holds; NodeMissing with ``failure`` after the start-up time."""
        timeout_s = self.settings.startup_timeout_s
        if not self.objects.until(condition, timeout_s):
            ids = ", ".join(str(node) for node in sorted(self._network.scanner.nodes))
            nodes = f"node-IDs heard: {ids}" if ids else "no node is heard on this bus"
            raise errors.NodeMissing(
                f"{self._name} {failure} within {timeout_s:g} s; {nodes}. Check the unit's "
                "supply, node-ID, bit rate, CAN cable and termination"
            )

    def _dispatch(self) -> None:
        network, watch = self._network, self._watch
        for t_s, message in self._source.drain():
            if message.is_error_frame:
                watch.on_error_frame(message.arbitration_id, message.data, t_s)
            elif of_another_kind(message):
                watch.on_foreign(t_s)
            elif len(message.data) != message.dlc:
                self._counts.malformed += 1
            else:
                if message.arbitration_id not in network.subscribers:
                    watch.on_foreign(t_s)
                network.notify(message.arbitration_id, message.data, t_s)

    def _sync(self, now_s: float, due_s: float) -> None:
        self._flow.before_sync()
        self._network.send_message(od.COB_SYNC, b"")
        self._counts.requests += 1
        period_s = self.settings.sync_period_s
        if now_s - due_s >= period_s:
            self._counts.late_requests += 1
            due_s = now_s
        self._next_sync_s = max(due_s + period_s, now_s + _LEAST_GAP * period_s)

    def _on_frame(self, _cob_id: int, data: bytes | bytearray, t_s: float) -> None:
        self._flow.messages += 1
        frame = self._assembler.push(data, t_s)
        if frame is not None:
            self._frames.append(frame)
            self._flow.on_frame(self._assembler.counts.lost)

    def _on_force(self, _cob_id: int, data: bytes | bytearray, t_s: float) -> None:
        assert self._force_flow is not None
        message = self._force_flow.push(data, t_s)
        if message is not None:
            self._new_forces.append(self._mounting.force(message))
