"""Finding the frames of a FlexiTac board in its bytes: lock, unlock, ambiguity, other profiles."""

import numpy as np
import pytest

from tactile.flexitac.stream import HEADER, PROFILES, FrameStream

PROFILE = PROFILES["16x16"]
PERIOD_S = 0.01


@pytest.fixture
def stream() -> FrameStream:
    return FrameStream(PROFILE)


def frames(n: int, seed: int = 0, profile: str = "16x16") -> list[bytes]:
    """Return frames of a pad at rest."""
    rng = np.random.default_rng(seed)
    size = PROFILES[profile].frame_bytes - 2
    return [HEADER + rng.integers(10, 40, size, dtype=np.uint8).tobytes() for _ in range(n)]


def locked(stream: FrameStream) -> float:
    """Lock a stream and return the time of its last frame in s."""
    for number, frame in enumerate(frames(4, seed=9)):
        stream.feed(frame, number * PERIOD_S)
    assert stream.locked
    return 3 * PERIOD_S


@pytest.mark.parametrize("cut", [0, 1, 2, 100, 257])
def test_a_stream_that_is_joined_anywhere_gives_whole_frames(cut: int) -> None:
    sent, stream = frames(8), FrameStream(PROFILE)
    got = []
    data = b"".join(sent)[cut:]
    for start in range(0, len(data), 64):
        got += stream.feed(data[start : start + 64], start / PROFILE.frame_bytes * PERIOD_S)
    assert stream.torn == 0
    assert len(got) >= 4
    # Bytes that trickle in without a pause show the end of the last frame by the next header.
    whole = sent[:-1]
    assert [one.samples for one in got] == [frame[2:] for frame in whole[-len(got) :]]


def test_frames_of_one_look_are_dated_by_their_order(stream) -> None:
    now_s = locked(stream) + 3 * PERIOD_S
    times_s = [one.t_s for one in stream.feed(b"".join(frames(3)), now_s)]
    assert times_s == pytest.approx([now_s - 2 * PERIOD_S, now_s - PERIOD_S, now_s])


def test_a_header_inside_that_comes_and_goes_does_not_matter(stream) -> None:
    sent = frames(6)
    sent[1] = sent[1][:50] + HEADER + sent[1][52:]
    got = [one for n, frame in enumerate(sent) for one in stream.feed(frame, n * PERIOD_S)]
    assert [one.samples for one in got] == [frame[2:] for frame in sent[-len(got) :]]


def test_a_header_inside_that_stays_is_ambiguous_until_it_goes(stream) -> None:
    for number, frame in enumerate(frames(30)):
        assert stream.feed(frame[:50] + HEADER + frame[52:], number * PERIOD_S) == []
    assert "ambiguous: AA 55 is at 2 places" in stream.trouble
    got = [
        one
        for number, frame in enumerate(frames(30, seed=1), start=30)
        for one in stream.feed(frame, number * PERIOD_S)
    ]
    assert stream.locked
    assert got[-1].samples == frames(30, seed=1)[-1][2:]


def test_a_header_inside_does_not_disturb_a_stream_that_is_locked(stream) -> None:
    now_s = locked(stream)
    for number, frame in enumerate(frames(10), start=1):
        marked = frame[:50] + HEADER + frame[52:]
        (got,) = stream.feed(marked, now_s + number * PERIOD_S)
        assert got.samples == marked[2:]


@pytest.mark.parametrize("place", [2, 3, 128, 257])
@pytest.mark.parametrize("extra", [False, True])
def test_a_frame_that_lost_or_gained_a_byte_is_never_handed_out(place: int, extra: bool) -> None:
    sent, stream = frames(12), FrameStream(PROFILE)
    now_s = locked(stream)
    hurt = sent[2][:place] + (b"\x07" + sent[2][place:] if extra else sent[2][place + 1 :])
    whole = {frame[2:] for frame in sent}
    got = []
    for number, frame in enumerate([*sent[:2], hurt, *sent[3:]], start=1):
        got += stream.feed(frame, now_s + number * PERIOD_S)
    assert stream.torn == 1
    assert {one.samples for one in got} <= whole
    # Three frames lock it anew.
    assert [one.samples for one in got][-6:] == [frame[2:] for frame in sent[-6:]]


def test_a_frame_that_ends_with_a_byte_of_the_next_one_waits_for_its_header(stream) -> None:
    now_s = locked(stream)
    one, other = frames(2)
    assert stream.feed(one[:-1], now_s + PERIOD_S) == []
    # The first byte of the next frame fills the place of the lost one, a period late.
    assert stream.feed(other[:1], now_s + 2 * PERIOD_S) == []
    assert stream.feed(other[1:], now_s + 2 * PERIOD_S + 0.002) == []
    assert stream.torn == 1


@pytest.mark.parametrize("sent", ["12x32", "16x32"])
def test_the_frames_of_another_profile_are_named(stream, sent: str) -> None:
    for number, frame in enumerate(frames(20, profile=sent)):
        assert stream.feed(frame, number * PERIOD_S) == []
    assert stream.trouble == f"its frames are {sent}: set tactile.sensor.profile to that"


def test_bytes_without_frames_are_named(stream) -> None:
    rng = np.random.default_rng(1)
    for number in range(20):
        assert stream.feed(rng.integers(0, 255, 258, dtype=np.uint8).tobytes(), number * 0.01) == []
    assert "no header repeats every 258 bytes" in stream.trouble
