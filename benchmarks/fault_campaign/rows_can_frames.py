"""Rows 1 to 8: lost, doubled, late and damaged frames, floods, the host's own controller."""

import threading
import time
from dataclasses import replace

import can

from benchmarks.fault_campaign._can_jobs import (
    BURST_S,
    LOOP_S,
    PERIOD_S,
    from_a_sync,
    near_cell,
    on_sync,
    plain,
    sets_lost,
    since,
)
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import observe
from cell.hand_local import LocalHand
from tactile.receive import ThreadedReceiver

_HOLD_S = 0.06 + LOOP_S
"""60 ms as in the table, counted from the first set that is missing, and seen by the next look."""


class _DyingBus(can.BusABC):
    """A bus whose driver fails with an error of its own at its second call."""

    def __init__(self) -> None:
        self.channel_info = "dying"
        self._calls = 0
        super().__init__("dying")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send nothing."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return nothing, then fail."""
        self._calls += 1
        if self._calls > 1:
            raise RuntimeError("the driver's buffer is damaged")
        return None


def _receiver_dies() -> Observed:
    """Let a real receive thread die; the link finds it dead in the middle of a grasp."""
    began_s: list[float] = []

    def die(number: int) -> None:
        hand = cell.controller.hand
        if number or not isinstance(hand, LocalHand):
            return
        bus = _DyingBus()
        receiver = ThreadedReceiver(bus, time)
        receiver.start()
        for thread in threading.enumerate():
            if thread.name == "tactile-receive":
                thread.join(5.0)
        bus.shutdown()
        vars(vars(hand.link)["_session"])["_source"] = receiver
        began_s.append(cell.now_s)

    with near_cell() as cell:
        observed = observe(cell, lambda: on_sync(cell, die))
        return since(cell, observed, began_s[0])


def _comes_back() -> Observed:
    """Pull the adapter out for 50 ms; back again, it must not go on by itself."""
    text = "can.unplugged@contact+0.1s..contact+0.15s"
    with near_cell() as cell:
        observed = observe(cell, text)
        state = cell.controller.state
        cell.simulated.clock.sleep(1.0)
        cell.controller.tick()
        if cell.controller.state is not state:
            return replace(observed, reaction=f"went from {state} to {cell.controller.state}")
        return observed


ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=1,
        fault="one tactile frame lost (one message of it)",
        injected="drop_next=1 on the link, with a SYNC",
        reaction="NOTE",
        limit_s=BURST_S + PERIOD_S + LOOP_S,
        run=lambda: sets_lost(lambda number: number == 0, crossing=1),
    ),
    FaultRow(
        row=1,
        variant="two in a row",
        fault="two tactile frames lost in a row",
        injected="drop_next=1 on the link, with two SYNCs",
        reaction="NOTE",
        limit_s=BURST_S + 2 * PERIOD_S + LOOP_S,
        run=lambda: sets_lost(lambda number: number < 2, crossing=1),
    ),
    FaultRow(
        row=2,
        variant="silence",
        fault="every set lost from one SYNC on",
        injected="can.loss=1, with a SYNC",
        reaction="HOLD",
        limit_s=_HOLD_S,
        run=lambda: from_a_sync("can.loss=1"),
    ),
    plain(
        2,
        "silence at any moment",
        "can.loss=1@contact+0.1s",
        "every set lost, beginning anywhere between two SYNCs",
    )("HOLD", _HOLD_S + PERIOD_S),
    plain(2, "bursts", "can.intermittent=0.2@contact+0.1s", "all lost for 0.1 s of each 0.5 s")(
        "HOLD", _HOLD_S + PERIOD_S
    ),
    FaultRow(
        row=2,
        variant="one set in five",
        fault="20 % of the sets lost, evenly; the limit counts from the set that is one too many",
        injected="drop_next=1 on the link, with each fifth SYNC",
        reaction="HOLD",
        limit_s=0.06,
        run=lambda: sets_lost(lambda number: number % 5 == 0, crossing=3),
    ),
    FaultRow(
        row=2,
        variant="one set in twenty",
        fault="5 % of the sets lost, evenly; the limit counts from the set that is one too many",
        injected="drop_next=1 on the link, with each 20th SYNC",
        reaction="HOLD",
        limit_s=0.06,
        run=lambda: sets_lost(lambda number: number % 20 == 0, crossing=3, hold_s=1.5),
    ),
    plain(3, "", "can.duplicate=0.2@contact", "every fifth message comes twice")("NOTE", None),
    plain(4, "reordered", "can.swapped=0.2@contact", "messages come after their successor")(
        "NOTE", None
    ),
    plain(
        4,
        "late by 100 ms",
        "can.delayed=0.1@contact+0.1s",
        "messages held back for 100 ms; the grip is held as for lost sets",
    )("HOLD", _HOLD_S + PERIOD_S),
    plain(
        4,
        "late by 45 ms",
        "can.delayed=0.045@contact+0.1s",
        "messages held back for 45 ms: fewer than three sets are missing; the third that is too "
        "old is one too many",
    )("HOLD", 0.045 + BURST_S + 3 * PERIOD_S + LOOP_S),
    plain(
        5,
        "corrupt payload",
        "can.garbage=1@contact+0.1s..contact+0.12s",
        "one bit turned in each message for one period",
    )("NOTE", PERIOD_S + BURST_S + LOOP_S),
    plain(5, "corrupt payload often", "can.garbage=0.01@contact+0.1s", "a bit in 1 % of messages")(
        "HOLD", 0.3
    ),
    plain(5, "wrong length", "can.wrong_dlc=0.05@contact+0.1s..contact+0.12s", "some of them")(
        "NOTE", None
    ),
    plain(5, "wrong length often", "can.wrong_dlc=0.5@contact+0.1s", "every second of them")(
        "HOLD", _HOLD_S
    ),
    plain(5, "short payload", "can.short=0.5@contact+0.1s", "fewer bytes than the length says")(
        "HOLD", _HOLD_S
    ),
    plain(5, "unknown COB-ID", "can.unknown_id=20@contact", "20 foreign messages a second")(
        "NOTE", 0.05 + LOOP_S
    ),
    plain(5, "unknown COB-ID often", "can.unknown_id=4000@contact", "4000 of them a second")(
        "HOLD", 0.06
    ),
    plain(5, "short EMCY", "can.short_emergency@contact", "an emergency of three bytes")(
        "NOTE", PERIOD_S + LOOP_S
    ),
    plain(6, "", "can.flood@contact+0.1s", "a flood of 8000 messages a second, the bus is full")(
        "HOLD", 0.06
    ),
    plain(
        7,
        "for 0.3 s",
        "can.passive@contact..contact+0.3s",
        "the host's controller is error-passive for 0.3 s",
    )("NOTE", 0.05),
    plain(7, "lasting", "can.passive@contact", "the host's controller stays error-passive")(
        "HOLD", 0.5 + 2 * LOOP_S
    ),
    plain(8, "bus-off", "can.off@contact+0.2s", "the host's CAN controller goes bus-off")(
        "HOLD", 0.1
    ),
    plain(8, "unplugged", "can.unplugged@contact+0.2s", "the CAN adapter is pulled out")(
        "HOLD", 0.1
    ),
    FaultRow(
        row=8,
        variant="back again",
        fault="the CAN adapter is out for 50 ms; no silent reconnect",
        injected="can.unplugged@contact+0.1s..contact+0.15s",
        reaction="HOLD",
        limit_s=0.1,
        run=_comes_back,
    ),
    FaultRow(
        row=8,
        variant="receiver dead",
        fault="the receive thread ends with an error of the driver",
        injected="a driver that raises RuntimeError in a real thread",
        reaction="HOLD",
        limit_s=0.1,
        run=_receiver_dies,
    ),
)
