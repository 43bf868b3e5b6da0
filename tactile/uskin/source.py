"""Frame source of two uSkin boards on one CAN bus, with z of the three axes as counts.

The messages have neither counter nor checksum. A cycle of a board is whole when each of its taxels
has sent once. If a taxel sends twice before, another message was lost, or there is a second board.
"""

from collections.abc import Callable, Sequence
from typing import Any

import can
import numpy as np

from tactile.board_source import Board, PolledBoards
from tactile.can.bus import interface_failed, message_source, of_another_kind, reopened
from tactile.clock import Clock
from tactile.errors import BusOff, DuplicateNode
from tactile.layout import TaxelLayout
from tactile.source import FrameStatistics, TactileFrame
from tactile.uskin.messages import FULL_SCALE, PERIOD_S, START, BoardIds, check_layout, samples

_GAP_SHARE = 0.3
"""Share of the period without a message that ends a board's cycle. The messages of a board follow
each other or are spread evenly. [chosen]"""
_CYCLES = 100
"""Number of newest cycles for the share without a taxel."""
_DOUBLED = 1.7
"""Multiple of the usual rate of cycles above which two boards have one address. [chosen]"""
_MIXED, _MIXED_PERIODS = 40, 3.0
"""Number of cycles that end too early within a number of periods, when the messages of two boards
alternate. Messages in transit from a board just removed give fewer. [chosen]"""
_BUS_OFF = 0x40
"""Class of an error frame in SocketCAN's identifier (linux/can/error.h)."""


class _Board(Board):
    """One board: its incoming cycle, and its newest whole one."""

    def __init__(self, finger: int, ids: BoardIds, *, falling: bool) -> None:
        self.ids, self._falling = ids, falling
        self._place = {identifier: n for n, identifier in enumerate(ids.taxels)}
        super().__init__(f"the board of finger {finger} (start {ids.start:X}h)", _CYCLES)

    def restart(self, now_s: float, counts: FrameStatistics) -> None:
        """Discard all samples."""
        super().restart(now_s, counts)
        self._xyz: dict[int, tuple[int, int, int]] = {}
        self._begun_s = self._message_s = now_s

    @property
    def trouble(self) -> str:
        """Reason of its silence and next step."""
        return f"{super().trouble}; a board that restarted sends after the next start"

    def take(self, identifier: int, xyz: tuple[int, int, int], t_s: float) -> None:
        """Add the samples of a taxel."""
        place = self._place[identifier]
        gap_s, self._message_s = t_s - self._message_s, t_s
        if place in self._xyz or (self._xyz and gap_s > _GAP_SHARE * PERIOD_S):
            self.tore(t_s)
            self._xyz.clear()
        if not self._xyz:
            self._begun_s = t_s
        self._xyz[place] = xyz
        if len(self._xyz) == len(self._place):
            xyz_of = np.array([self._xyz[n] for n in range(len(self._place))], dtype=np.uint16)
            cycle = xyz_of[:, [2, 0, 1]]
            if self._falling:
                cycle[:, 0] = FULL_SCALE - cycle[:, 0]
            self.saw(self._begun_s, t_s, cycle)
            self._xyz.clear()

    @property
    def loss_rate(self) -> float:
        """Share of the newest cycles that lack a taxel; 0 where they may be those of two boards."""
        # More than two in a period are no loss: the check for a doubled board follows soon.
        return super().loss_rate if self.mixed <= 2.0 * _MIXED_PERIODS else 0.0

    @property
    def mixed(self) -> int:
        """Cycles of the last periods that ended too early."""
        since_s = self._message_s - _MIXED_PERIODS * PERIOD_S
        return sum(t_s > since_s and not whole for t_s, whole in self.ended)

    @property
    def doubled(self) -> bool:
        """Whether the rate of the taxels is so high that two boards must send them."""
        full = len(self.ended) == _CYCLES
        span_s = self.ended[-1][0] - self.ended[0][0] if full else _CYCLES * PERIOD_S
        return self.mixed >= _MIXED or span_s < _CYCLES * PERIOD_S / _DOUBLED


class UskinSource(PolledBoards[_Board]):
    """Two uSkin boards on one CAN bus; implements `tactile.source.FrameSource`.

    Raises LayoutError where the layout has other pads than the boards' taxels.

    Parameters
    ----------
    bus
        An open bus without CANopen nodes: their heartbeats have the same identifiers.
    boards
        Identifiers of the board on finger 0 and on finger 1.
    falling
        Whether z falls under a force; counts rise in both cases.
    reopen
        Opens the bus again after its loss.
    options
        Further arguments of `PolledBoards`.
    """

    silent_periods = 6.0
    """Least silence without a whole cycle that is a fault, in periods. [chosen]"""
    unit = "whole cycle"

    def __init__(
        self,
        bus: can.BusABC,
        boards: Sequence[BoardIds],
        *,
        layout: TaxelLayout,
        clock: Clock,
        falling: bool = False,
        reopen: Callable[[], can.BusABC] | None = None,
        **options: Any,
    ) -> None:
        check_layout(layout, boards)
        parts = [_Board(finger, ids, falling=falling) for finger, ids in enumerate(boards)]
        super().__init__("uSkin", parts, layout=layout, clock=clock, period_s=PERIOD_S, **options)
        self._bus, self._reopen = bus, reopen
        self._owner = {i: board for board in self._boards for i in board.ids.taxels}
        self._source = message_source(self._bus)

    def _absent(self, board: _Board) -> str:
        n_taxels = len(board.ids.taxels)
        return (
            f"{board.name} sent no whole cycle of {n_taxels} taxels within {self._startup_s:g} s; "
            f"{self._counts.foreign} messages have identifiers that tactile.sensor.boards does not "
            "name: check cable, supply, address and that map"
        )

    def open(self) -> None:
        """Open a lost bus again, and start both boards."""
        self._bus = reopened(self._bus, self.fault, self._reopen)
        self._source = message_source(self._bus)
        self._source.start()
        for board in self._boards:
            try:
                self._bus.send(can.Message(0.0, board.ids.start, False, data=START))
            except (can.CanError, OSError) as error:
                raise interface_failed(error) from error

    def _receive(self) -> list[TactileFrame]:
        frames: list[TactileFrame] = []
        for t_s, message in self._source.drain():
            if message.is_error_frame:
                self._counts.error_frames += 1
                if message.arbitration_id & _BUS_OFF:
                    raise BusOff(
                        "the CAN controller is off the bus: check cable, termination and bit rate"
                    )
                continue
            board = self._owner.get(message.arbitration_id)
            if board is None or of_another_kind(message):
                self._counts.foreign += 1
                continue
            xyz = samples(message.data)
            if xyz is None:
                self._counts.malformed += 1
                continue
            board.take(message.arbitration_id, xyz, t_s)
            frames += self._new_frames()
        for board in self._boards:
            if board.doubled:
                raise DuplicateNode(
                    f"the taxels of {board.name} come more than {_DOUBLED:g} times as often as "
                    "usual: two boards have its address; set one to another, then start again"
                )
        return frames

    def close(self) -> None:
        """Stop receiving; the boards continue and the bus stays open."""
        self._source.close()
