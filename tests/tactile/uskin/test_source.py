"""The frame source of two uSkin boards: their messages, and simulated boards in virtual time."""

from collections.abc import Iterator

import can
import numpy as np
import pytest

from simulator.boards.uskin import UskinBoard, UskinSettings
from simulator.cell import SimulatedCell
from simulator.errors import SimulatorSettingsError
from simulator.settings import SimulatorSettings
from tactile.errors import BusOff, DuplicateNode, FrameTimeout, LayoutError
from tactile.layout import LAYOUTS, PadMount
from tactile.uskin.messages import BoardIds, samples, xr1944
from tactile.uskin.source import UskinSource
from tests.tactile.conftest import run

LAYOUT = LAYOUTS["uskin_4x4"]()
NEWER = [
    BoardIds(
        start=0x203 + board,
        taxels=tuple(
            row * 0x100 + column * 0x10 + 3 + board for row in range(4) for column in range(4)
        ),
    )
    for board in (0, 1)
]
"""Identifiers of newer boards: row x 100h + column x 10h + address."""


def simulated(ids: list[BoardIds], *, falling: bool = False) -> SimulatedCell:
    first, second = (UskinBoard(start_id=one.start, taxel_ids=one.taxels) for one in ids)
    boards = UskinSettings(boards=(first, second), falling=falling)
    return SimulatedCell(SimulatorSettings(layout=LAYOUT, boards=boards))


@pytest.fixture
def cell() -> Iterator[SimulatedCell]:
    with simulated([xr1944(1), xr1944(2)]) as one:
        yield one


@pytest.fixture
def source(cell: SimulatedCell) -> UskinSource:
    return make_source(cell, [xr1944(1), xr1944(2)])


def make_source(cell: SimulatedCell, ids: list[BoardIds], **changes: object) -> UskinSource:
    return UskinSource(
        cell.can_bus,
        ids,
        layout=LAYOUT,
        clock=cell.clock,
        reopen=cell.open_can_bus,
        **changes,  # type: ignore[arg-type]
    )


def test_the_samples_of_a_message_stand_high_byte_first() -> None:
    assert samples(bytes.fromhex("0A 7E 31 7E 32 93 12")) == (0x7E31, 0x7E32, 0x9312)
    assert samples(bytes.fromhex("00 00 01 00 02 FF FF 77")) == (1, 2, 0xFFFF)
    assert samples(bytes(6)) is None
    assert xr1944(1) == BoardIds(start=0x201, taxels=tuple(range(0x710, 0x720)))


def test_a_press_on_newer_boards_whose_counts_fall_shows_at_its_place() -> None:
    with simulated(NEWER, falling=True) as cell:
        source = make_source(cell, NEWER, falling=True)
        assert source.start().name == "uSkin"
        rest = np.mean([one.counts for one in run(cell, source, 0.5)], axis=0)
        for pad, place_m in ((0, (0.007, -0.002)), (1, (-0.002, 0.007))):
            cell.world.press(pad, *place_m, 4.0)  # type: ignore[union-attr]
            change = run(cell, source, 0.1)[-1].counts - rest
            taxel = int(np.argmax(change))
            assert LAYOUT.taxel_pad[taxel] == pad
            assert LAYOUT.taxel_xy_m[taxel] == pytest.approx(place_m, abs=0.003)
            assert 2000 < change.max() < 12000
            cell.world.lift()  # type: ignore[union-attr]


def test_frames_come_at_the_rate_of_the_boards_and_in_the_mounted_order(cell) -> None:
    mounts = [PadMount(pad=0, sent_as=1, rows_mirrored=True), PadMount(pad=1, sent_as=0)]
    source = make_source(cell, [xr1944(1), xr1944(2)], mounts=mounts)
    source.start()
    frames = run(cell, source, 1.0)
    assert 95 <= len(frames) <= 105
    assert all(one.t_s - one.scanned_s < 0.012 for one in frames)
    assert source.statistics.frames.torn == source.statistics.foreign == 0
    for one in frames:
        np.testing.assert_allclose(one.extra, np.full((32, 2), 0x7E31), atol=100)
    cell.world.press(1, 0.007, 0.002, 8.0)  # type: ignore[union-attr]
    taxel = int(np.argmax(run(cell, source, 0.1)[-1].counts))
    assert LAYOUT.taxel_pad[taxel] == 0
    assert LAYOUT.taxel_xy_m[taxel] == pytest.approx((-0.007, 0.002), abs=0.003)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "error", "named"),
    [
        ("uskin.off=1", FrameTimeout, r"finger 1 \(start 202h\) has sent no whole cycle"),
        ("uskin.low_supply=0", FrameTimeout, "a board that restarted sends after the next start"),
        ("uskin.doubled=1", DuplicateNode, r"finger 1 .*: two boards have its address"),
        ("can.loss=0.2", FrameTimeout, "were damaged|no whole cycle"),
        ("can.off", BusOff, "off the bus"),
    ],
)
def test_a_fault_in_operation_is_named(cell, source, fault, error, named) -> None:
    source.start()
    run(cell, source, 0.2)
    cell.inject(fault)
    with pytest.raises(error, match=named):
        run(cell, source, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "error", "named"),
    [
        ("uskin.off=0", FrameTimeout, "finger 0 .* sent no whole cycle of 16 taxels within 3 s"),
        ("uskin.doubled=0", DuplicateNode, "finger 0 .*: two boards have its address"),
    ],
)
def test_a_fault_at_the_start_is_named(cell, source, fault, error, named) -> None:
    cell.inject(fault)
    with pytest.raises(error, match=named):
        source.start()
    assert isinstance(source.fault, error)


def test_a_board_that_soon_repeats_a_cycle_has_no_torn_ones(source) -> None:
    board = source._boards[0]
    for n in range(40):
        for place, identifier in enumerate(board.ids.taxels):
            board.take(identifier, (1, 2, min(n, 30) + place), 0.01 * n + 1e-4 * place)
    assert (board.mixed, board.counts.duplicate) == (0, 9)


@pytest.mark.slow
def test_another_map_of_identifiers_shows_as_foreign_messages() -> None:
    with simulated([xr1944(1), xr1944(2)]) as cell:
        wrong = BoardIds(start=0x201, taxels=NEWER[0].taxels)
        with pytest.raises(FrameTimeout, match=r"[1-9][0-9]+ messages have identifiers that"):
            make_source(cell, [wrong, xr1944(2)]).start()


@pytest.mark.slow
def test_single_lost_messages_cost_one_frame_each(cell: SimulatedCell, source: UskinSource) -> None:
    source.start()
    run(cell, source, 0.2)
    n = 0
    for _ in range(4):
        cell.inject("can.lose_next=1")
        n += len(run(cell, source, 0.39))
    assert source.statistics.frames.torn == 4
    assert 4 * 35 <= n <= 4 * 39


def test_short_and_foreign_messages_are_counted_and_left_out(cell, source) -> None:
    source.start()
    send = cell.devices.can._deliver
    send(cell.clock.monotonic(), 0x710, [b"\x00\x01"])
    send(cell.clock.monotonic(), 0x123, [bytes(8)])
    run(cell, source, 0.1)
    assert (source.statistics.malformed, source.statistics.foreign) == (1, 1)


def test_boards_that_do_not_fit_are_refused(cell: SimulatedCell) -> None:
    with pytest.raises(LayoutError, match="identifiers of the boards repeat"):
        make_source(cell, [xr1944(1), xr1944(1)])
    with pytest.raises(LayoutError, match=r"pads of \[16, 16\] taxels, the boards have \[16, 8\]"):
        make_source(cell, [xr1944(1), xr1944(2, n_taxels=8)])


def test_the_boards_hear_nothing_but_their_start(cell: SimulatedCell) -> None:
    for data in (b"\x07", b"\x07\x01"):
        cell.can_bus.send(can.Message(0.0, 0x201, False, data=data))
    cell.clock.sleep(0.1)
    assert cell.can_bus.recv_all(100) == []
    for fault, why in (
        ("board.off", "no sensor boards on serial lines"),
        ("unit.pre_operational", "sensor boards, no control unit"),
    ):
        with pytest.raises(SimulatorSettingsError, match=why):
            cell.inject(fault)
