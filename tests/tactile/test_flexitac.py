"""FlexiTac boards: frames in their bytes, and the frame source on simulated boards."""

from collections.abc import Iterator
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from simulator.boards.flexitac import FlexiTacSettings
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.board_source import Board
from tactile.errors import FrameTimeout, LayoutError, LinkFault
from tactile.flexitac import HEADER, PROFILES, FlexiTacBoard, FlexiTacSource
from tactile.layout import LAYOUTS, TaxelLayout
from tactile.source import ScanStatus
from tests.tactile.conftest import run

LAYOUT = LAYOUTS["flexitac_12x32"]()


@pytest.fixture
def cell() -> Iterator[SimulatedCell]:
    with SimulatedCell(SimulatorSettings(layout=LAYOUT, boards=FlexiTacSettings())) as one:
        yield one


@pytest.fixture
def source(cell: SimulatedCell) -> FlexiTacSource:
    return make_source(cell)


def make_source(cell: SimulatedCell, **changes: object) -> FlexiTacSource:
    values = {"profile": PROFILES["12x32"], "layout": LAYOUT, "clock": cell.clock} | changes
    return FlexiTacSource([partial(cell.open_board, n) for n in (0, 1)], **values)  # type: ignore[arg-type]


def test_a_square_board_may_sit_either_way() -> None:
    layout = LAYOUTS["flexitac_16x16"]()
    for rows_along in (False, True):
        settings = FlexiTacSettings(rows=16, columns=16, rows_along=rows_along)
        with SimulatedCell(SimulatorSettings(layout=layout, boards=settings)) as cell:
            profile = PROFILES["16x16"]
            source = make_source(cell, profile=profile, layout=layout, rows_along=rows_along)
            source.start()
            cell.world.press(0, 0.01, -0.004, 5.0)  # type: ignore[union-attr]
            place_m = layout.taxel_xy_m[int(np.argmax(run(cell, source, 0.2)[-1].counts))]
            assert place_m == pytest.approx((0.01, -0.004), abs=0.002)


def test_a_layout_of_another_size_is_refused(cell) -> None:
    wrong: TaxelLayout = LAYOUTS["flexitac_16x32"]()
    with pytest.raises(LayoutError, match="two inner pads of 32 rows along the finger and 12"):
        make_source(cell, layout=wrong)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("board.unplugged=1", "the line of the board of finger 1 is gone"),
        ("board.off=0", "the board of finger 0 has sent no new frame of 12 x 32 for"),
        ("board.frozen=1", "the board of finger 1 has sent no new frame .*: it repeats one frame"),
        ("board.rows=16", "its frames are 16x32: set tactile.sensor.profile"),
        ("board.lost_byte=0.5", "were damaged|no new frame"),
        ("board.torn=0.5", "were damaged|no new frame"),
    ],
)
def test_a_fault_in_operation_is_named(cell, source, fault, named) -> None:
    source.start()
    run(cell, source, 1.0)
    cell.inject(fault)
    with pytest.raises(LinkFault, match=named):
        run(cell, source, 1.5)


def test_repeated_frames_are_not_handed_out_as_fresh_ones(cell, source) -> None:
    source.start()
    run(cell, source, 0.5)
    cell.inject("board.repeated=0.2")
    frames = run(cell, source, 2.0)
    assert source.statistics.frames.duplicate > 40
    assert sum(a == b for a, b in pairwise([one.counts[:384].tobytes() for one in frames])) == 0


def test_a_burst_after_a_late_frame_does_not_go_back_in_time() -> None:
    board = Board("finger 0")
    for n, t_s in enumerate((1.1, 1.35, 1.3, 1.4)):
        board.saw(t_s, t_s, np.array([n, 1], dtype=np.uint16))
    assert [t_s for _, t_s, _ in board.waiting] == [1.1, 1.35, 1.35, 1.4]


def test_bytes_that_nobody_fetched_for_long_are_dropped(cell, source) -> None:
    source.start()
    run(cell, source, 0.2)
    cell.clock.sleep(1.0)
    cell.world.press(0, 0.0, 0.0, 5.0)  # type: ignore[union-attr]
    asked_s = cell.clock.monotonic()
    frames = run(cell, source, 0.2)
    assert frames
    # The mean of the samples is half a period of the board older than their last byte.
    assert all(0.0049 < one.t_s - one.scanned_s < 0.0151 for one in frames)
    assert all(one.t_s >= asked_s and one.counts.max() > 50 for one in frames)
    assert source.statistics.frames.lost >= 90


def test_a_static_load_is_harmless_after_the_start(cell, source) -> None:
    source.start()
    cell.inject("board.marked=0")
    assert run(cell, source, 1.0)
    assert source.statistics.frames.torn == 0


def test_a_saturated_taxel_is_in_the_status(cell, source) -> None:
    source.start()
    assert run(cell, source, 0.1)[-1].status == 0
    cell.inject("taxels.stuck_at=5:255")
    assert run(cell, source, 0.1)[-1].status == ScanStatus.SATURATED


def test_a_load_that_looks_like_a_header_at_the_start_is_named(cell, source) -> None:
    cell.inject("board.marked=0")
    with pytest.raises(FrameTimeout, match=r"board of finger 0 .* ambiguous: .* take the load"):
        source.start()


PROFILE = PROFILES["16x16"]
PERIOD_S = 0.01


@pytest.fixture
def stream() -> FlexiTacBoard:
    return FlexiTacBoard(0, PROFILE, rows_along=False)


def frames(n: int, seed: int = 0, profile: str = "16x16") -> list[bytes]:
    """Return frames of a pad at rest."""
    rng = np.random.default_rng(seed)
    size = PROFILES[profile].frame_bytes - 2
    return [HEADER + rng.integers(10, 40, size, dtype=np.uint8).tobytes() for _ in range(n)]


def locked(stream: FlexiTacBoard) -> float:
    """Lock a stream and return the time of its last frame in s."""
    for number, frame in enumerate(frames(4, seed=9)):
        stream.feed(frame, number * PERIOD_S)
    assert stream.locked
    return 3 * PERIOD_S


@pytest.mark.parametrize("cut", [0, 1, 2, 100, 257])
def test_a_stream_that_is_joined_anywhere_gives_whole_frames(stream, cut: int) -> None:
    sent, got = frames(8), []
    data = b"".join(sent)[cut:]
    for start in range(0, len(data), 64):
        got += stream.feed(data[start : start + 64], start / PROFILE.frame_bytes * PERIOD_S)
    assert stream.counts.torn == 0
    assert len(got) >= 4
    # Bytes that trickle in without a pause show the end of the last frame by the next header.
    assert [samples for _, samples in got] == [frame[2:] for frame in sent[:-1][-len(got) :]]


def test_frames_of_one_look_are_dated_by_their_order(stream) -> None:
    now_s = locked(stream) + 3 * PERIOD_S
    times_s = [t_s for t_s, _ in stream.feed(b"".join(frames(3)), now_s)]
    assert times_s == pytest.approx([now_s - 2 * PERIOD_S, now_s - PERIOD_S, now_s])


@pytest.mark.parametrize("marked", [(1,), (0, 1, 2, 3)])
def test_a_header_inside_that_comes_and_goes_does_not_matter(stream, marked) -> None:
    sent, got = frames(16), []
    for n in marked:
        sent[n] = sent[n][:50] + HEADER + sent[n][52:]
    for n, frame in enumerate(sent):
        got += stream.feed(frame, n * PERIOD_S)
        assert "ambiguous" not in stream.trouble
    assert got
    assert [samples for _, samples in got] == [frame[2:] for frame in sent[-len(got) :]]


@pytest.mark.parametrize("place", [2, 3, 128, 257])
@pytest.mark.parametrize("extra", [False, True])
def test_a_frame_that_lost_or_gained_a_byte_is_never_handed_out(stream, place, extra) -> None:
    sent, now_s = frames(12), locked(stream)
    hurt = sent[2][:place] + (b"\x07" + sent[2][place:] if extra else sent[2][place + 1 :])
    whole, got = {frame[2:] for frame in sent}, []
    for number, frame in enumerate([*sent[:2], hurt, *sent[3:]], start=1):
        got += stream.feed(frame, now_s + number * PERIOD_S)
    assert stream.counts.torn == 1
    assert {samples for _, samples in got} <= whole
    # Three frames lock it anew.
    assert [samples for _, samples in got][-6:] == [frame[2:] for frame in sent[-6:]]


def test_a_frame_that_ends_with_a_byte_of_the_next_one_waits_for_its_header(stream) -> None:
    now_s = locked(stream)
    one, other = frames(2)
    assert stream.feed(one[:-1], now_s + PERIOD_S) == []
    # The first byte of the next frame fills the place of the lost one, a period late.
    assert stream.feed(other[:1], now_s + 2 * PERIOD_S) == []
    assert stream.feed(other[1:], now_s + 2 * PERIOD_S + 0.002) == []
    assert stream.counts.torn == 1


def test_bytes_without_frames_are_named(stream) -> None:
    rng = np.random.default_rng(1)
    for number in range(20):
        assert stream.feed(rng.integers(0, 255, 258, dtype=np.uint8).tobytes(), number * 0.01) == []
    assert "no header repeats every 258 bytes" in stream.trouble
