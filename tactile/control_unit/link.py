"""The link to the control unit: starts it, supervises it, and returns complete frames or a fault.

canopen does the SDO service; frame messages bypass it, from the raw COB-ID to the assembler.
"""

from collections.abc import Callable
from dataclasses import replace
from math import sqrt
from typing import TypeVar

import can
import numpy as np

from tactile.can.bus import MissingBus
from tactile.can.receiver import message_source
from tactile.clock import Clock
from tactile.control_unit import object_dictionary
from tactile.control_unit.commissioning import (
    Check,
    identity_checks,
    layout_checks,
    read_identity,
    refuse_mismatch,
    refuse_stored_values,
    refuse_swapped_boards,
    set_up,
    set_up_forces,
)
from tactile.control_unit.mounting import Mounting
from tactile.control_unit.session import LinkSession
from tactile.control_unit.settings import LinkSettings, NodeIdentity
from tactile.control_unit.supervision import OPERATIONAL
from tactile.errors import BusOff, LinkFault, LinkStateError, NodeMissing, ReceiveLoopDead
from tactile.frames.force_message import encode_zero
from tactile.layout import TaxelLayout
from tactile.source import Arrivals, ForceStatus, PadZero, SourceStatistics

_Result = TypeVar("_Result")

_TOUCH_SIGMAS = 5.0
"""The unit's threshold of touched taxels, in standard deviations of its mean."""
_UNIT_GAIN = 6.0 / 16.0 * sqrt(1.0 / 7.0)
"""Factor of the unit's mean on independent noise: binomial over 3 x 3 taxels, running over 4 scans.
"""
_TOUCH_SHARE = 0.012
"""Least threshold as a share of the full scale: above the allowed drift of a zero."""


class TactileLink:
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
    clock
        Monotonic time; real time if ``settings.threaded``.
    force_table
        Object 0x2141, the table for the unit's sum of the force; None: no force messages.
    reopen
        Opens a lost bus again; without it a lost bus stays lost.
    """

    def __init__(
        self,
        bus: can.BusABC,
        *,
        node_id: int,
        layout: TaxelLayout,
        clock: Clock,
        settings: LinkSettings | None = None,
        force_table: bytes | None = None,
        reopen: Callable[[], can.BusABC] | None = None,
    ) -> None:
        if not 1 <= node_id <= 127:
            raise ValueError(f"node-ID is {node_id}, must be 1 to 127")
        self._bus = bus
        self._reopen = reopen
        self._node_id = node_id
        self.layout = layout
        """The taxels of the unit."""
        self._clock = clock
        self.settings = settings or LinkSettings()
        """Periods and limits."""
        self._mounting = Mounting(layout, self.settings.mounts)
        # The unit's sums are valid only for the gripping pads in their mounting.
        sums = self.settings.force_period_s and self._mounting.unit_can_sum
        self._force_table = force_table if sums else None
        self._source = message_source(self._bus, self._clock, threaded=self.settings.threaded)
        self._session = self._new_session()
        self._running = False
        self.fault: LinkFault | None = None
        """The latched fault, None without one."""

    def _new_session(self) -> LinkSession:
        return LinkSession(
            self._bus,
            self._source,
            node_id=self._node_id,
            layout=self.layout,
            clock=self._clock,
            settings=self.settings,
        )

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the last start."""
        return self._session.statistics

    def start(self) -> NodeIdentity:
        """Reset the unit's communication, check it, set it up and start its frames.

        Returns its identity when it is operational. Raises NodeMissing if it does not boot in time,
        IdentityMismatch for another unit, and any other LinkFault. Allowed again after `stop`,
        which clears a latched fault.
        """
        if self._running:
            raise LinkStateError("the link runs already: stop it before starting again")
        lost = isinstance(self.fault, BusOff | ReceiveLoopDead)
        if self._reopen is not None and (lost or isinstance(self._bus, MissingBus)):
            self._bus = self._reopen()
            self._source = message_source(self._bus, self._clock, threaded=self.settings.threaded)
        self._running = True
        self.fault = None
        self._session = self._new_session()
        return self._guarded(self._commission)

    def _commission(self) -> NodeIdentity:
        session = self._session
        supervisor = session.supervisor
        self._source.start()
        session.command("RESET COMMUNICATION")
        session.wait_for(lambda: supervisor.boot_ups > 0, "did not boot")
        identity = read_identity(session.objects)
        refuse_swapped_boards(identity, self.settings.identity, session.name)
        other = f"{session.name} is not the configured unit"
        refuse_mismatch(identity_checks(identity, self.settings.identity), other)
        refuse_mismatch(layout_checks(session.objects, self.layout, self._node_id), other)
        refuse_stored_values(session.objects, session.name)
        set_up(session.objects, self.settings)
        if (
            self._force_table is not None
            and session.objects.find(object_dictionary.FORCE_MESSAGE) is not None
        ):
            session.expect_forces(
                set_up_forces(session.objects, self.settings, self._node_id, self._force_table)
            )
        if supervisor.boot_ups > 1:
            raise NodeMissing(
                f"{session.name} booted {supervisor.boot_ups} times while it was set up: its "
                "supply is unstable, or two units have the same node-ID"
            )
        session.command("OPERATIONAL")
        session.wait_for(lambda: supervisor.state == OPERATIONAL, "did not become operational")
        session.enter_operation()
        session.service()
        return replace(identity, sends_forces=session.sends_forces)

    def poll(self) -> Arrivals:
        """Return the complete frames and force messages since the last call; does not wait."""
        self._guarded(self._session.service)
        return self._mounting.arrivals(self._session.take())

    @property
    def sends_forces(self) -> bool:
        """Whether the unit was set up to send force messages."""
        return self._session.sends_forces

    def set_zero(self, zero: PadZero) -> None:
        """Write object 0x2142, the zero of the force messages, and read it back.

        Does nothing if the unit sends none. Raises IdentityMismatch if the unit did not store it,
        and FrameTimeout if messages from before the write still come after it. Takes tens of ms;
        the messages of that time are dropped.
        """
        if not self.sends_forces:
            return
        noise_counts, adc_max = float(np.median(zero.noise_counts)), self.layout.adc_max
        touch_counts = max(_TOUCH_SIGMAS * noise_counts * _UNIT_GAIN, _TOUCH_SHARE * adc_max)
        sent = self._mounting.zero(encode_zero(touch_counts, zero.offset_counts, zero.bad, adc_max))

        def write() -> None:
            session = self._session
            objects = session.objects
            objects.write(object_dictionary.FORCE_ZERO, 0, sent)
            session.drop_forces()
            found = objects.read(object_dictionary.FORCE_ZERO)
            old = [one for one in session.drop_forces() if not one.status & ForceStatus.ZEROED]
            late_s = len(old) * self.settings.force_period_s
            if late_s > self.settings.force_late_s:
                raise session.forces_late(late_s)
            refuse_mismatch(
                [Check("zero of the force", sent.hex(), found.hex())],
                f"{self._session.name} did not keep its zero",
            )
            session.drop_forces()

        self._guarded(write)

    def stop(self) -> None:
        """Stop the frames and the receiver; does not raise on a dead bus, leaves the bus open."""
        if self._running:
            self._running = False
            self._session.leave_operation()
            try:
                self._session.command("PRE-OPERATIONAL")
            except LinkFault as fault:
                # The command does not reach the unit; its frames end without SYNCs.
                self.fault = self.fault or fault
        self._source.close()

    def _guarded(self, action: Callable[[], _Result]) -> _Result:
        """Return the result of an action that needs a link without a fault; a fault latches."""
        if self.fault is not None:
            raise self.fault
        if not self._running:
            raise LinkStateError("the link is not running: start it first")
        try:
            return action()
        except LinkFault as fault:
            self.fault = fault
            self._session.leave_operation()
            raise
