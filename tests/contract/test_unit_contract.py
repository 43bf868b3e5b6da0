"""What the tactile control unit does on its bus, simulated or real (its EDS, CiA 301)."""

import struct
from itertools import pairwise

import pytest

from tactile.control_unit import object_dictionary as od

PRE_OPERATIONAL, OPERATIONAL = 127, 5
ABORT = 0x80
READ = 0x40
WRITE_2, WRITE_4, WRITTEN = 0x2B, 0x23, 0x60

NO_SUCH_OBJECT = 0x0602_0000
NO_SUCH_SUBINDEX = 0x0609_0011
READ_ONLY = 0x0601_0002
UNKNOWN_COMMAND = 0x0504_0001


def request(command: int, index: int, subindex: int, value: int = 0) -> bytes:
    return struct.pack("<BHBL", command, index, subindex, value)


def test_the_unit_is_what_its_eds_says(unit) -> None:
    identity = unit.link.start()  # compares layout, formats and mapping, or raises
    assert (identity.vendor_id, identity.product_code) == (od.VENDOR_ID, od.PRODUCT_CODE)
    assert identity.revision >> 16 == od.REVISION >> 16
    assert identity.name


def test_each_sync_gives_one_whole_frame(unit) -> None:
    unit.link.start()
    frames = unit.frames(20 * unit.link.settings.sync_period_s)
    assert 18 <= len(frames) <= 21
    assert all((b.counter - a.counter) & 0xFFFF == 1 for a, b in pairwise(frames))
    layout = unit.link.layout
    for frame in frames:
        assert frame.counts.shape == (layout.n_taxels,)
        assert frame.counts.max() <= layout.adc_max
    found = unit.link.statistics
    assert len(frames) <= found.requests
    counts = found.frames
    assert (counts.lost, counts.torn, counts.short, counts.corrupt) == (0, 0, 0, 0)


def test_without_sync_no_frame_comes(unit) -> None:
    unit.link.start()
    unit.frames(0.1)
    unit.link.stop()
    end_s = unit.clock.monotonic() + 0.05
    while unit.clock.monotonic() < end_s:
        unit.receive(0x180 + unit.node_id, 0.01)  # what was on its way
    assert unit.receive(0x180 + unit.node_id, 0.2) is None


def test_the_last_frame_can_be_read_by_sdo_too(unit) -> None:
    unit.link.start()
    frames = unit.frames(0.1)
    samples = unit.link._session.objects.read(od.LAST_FRAME)
    counter = unit.link._session.objects.read_unsigned(od.LAST_FRAME_COUNTER)
    frames += unit.frames(0.1)
    (same,) = [frame for frame in frames if frame.counter == counter]
    assert same.counts.astype(f"<u{unit.link.layout.sample_bytes}").tobytes() == samples


def test_a_reset_is_told_by_a_boot_up_and_ends_pre_operational(unit) -> None:
    unit.send(0, bytes((1, unit.node_id)))
    unit.reset()  # fails without a boot-up
    answer = unit.sdo(request(WRITE_2, od.HEARTBEAT_MS, 0, 50))
    assert answer[0] == WRITTEN
    assert unit.receive(0x700 + unit.node_id)[1] == bytes([PRE_OPERATIONAL])


def test_the_heartbeat_comes_as_often_as_it_is_set(unit) -> None:
    node, period_s = unit.node_id, 0.1
    answer = unit.sdo(request(WRITE_2, od.HEARTBEAT_MS, 0, round(1000 * period_s)))
    assert answer[0] == WRITTEN
    beats = [unit.receive(0x700 + node, 2.0) for _ in range(6)]
    assert all(beat is not None for beat in beats)
    gaps_s = [b[0] - a[0] for a, b in pairwise(beats[1:])]
    assert all(gap_s == pytest.approx(period_s, rel=0.5) for gap_s in gaps_s), gaps_s
    assert sum(gaps_s) == pytest.approx(len(gaps_s) * period_s, rel=0.2)
    assert all(beat[1] == bytes([PRE_OPERATIONAL]) for beat in beats[1:])
    unit.send(0, bytes((1, node)))
    states = [unit.receive(0x700 + node, 2.0)[1][0] for _ in range(3)]
    assert states[-1] == OPERATIONAL


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        (request(READ, 0x5FFF, 0), NO_SUCH_OBJECT),
        (request(READ, od.IDENTITY, 9), NO_SUCH_SUBINDEX),
        (request(WRITE_4, od.IDENTITY, od.IDENTITY_VENDOR, 1), READ_ONLY),
        (request(0xE0, od.IDENTITY, 1), UNKNOWN_COMMAND),
    ],
    ids=["no object", "no sub-index", "read only", "no command"],
)
def test_what_cannot_be_done_is_aborted_with_its_code(unit, asked: bytes, code: int) -> None:
    answer = unit.sdo(asked)
    assert answer[0] == ABORT
    assert answer[1:4] == asked[1:4]
    assert int.from_bytes(answer[4:], "little") == code
    # and the server still serves
    vendor = unit.sdo(request(READ, od.IDENTITY, od.IDENTITY_VENDOR))
    assert int.from_bytes(vendor[4:], "little") == od.VENDOR_ID


def test_a_stray_write_takes_no_zero(unit) -> None:
    answer = unit.sdo(request(WRITE_4, od.TARE, od.TARE_COMMAND, 1))
    assert answer[0] == ABORT
