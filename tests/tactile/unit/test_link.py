"""The link: start-up, frames, and every fault of the control unit."""

import can
import numpy as np
import pytest
from canopen.emcy import EMCY_STRUCT

from tactile.errors import (
    BusDisturbed,
    BusErrorPassive,
    BusOff,
    DuplicateNode,
    FrameError,
    FrameTimeout,
    HeartbeatLost,
    IdentityMismatch,
    LinkStateError,
    NodeEmergency,
    NodeMissing,
    NodeRebooted,
    NodeStateChanged,
    TareRefused,
)
from tactile.frames.flow import FrameFlow
from tactile.layout import paper_layout, pinch_layout
from tactile.unit import object_dictionary as od
from tactile.unit.link import ExpectedIdentity, LinkSettings, TactileLink

NODE = 5


def sync_times(bench) -> int:
    return sum(message.arbitration_id == 0x80 for message in bench.bus.sent)


def test_start_checks_configures_and_starts_the_unit(bench) -> None:
    identity = bench.link.start()
    assert identity.serial == 4711
    assert identity.name == "Tactile control unit"
    assert bench.unit.nmt == [130, 1]
    assert bench.unit.written == {
        (od.SYNC_COB_ID, 0): 0x80,
        (od.SYNC_WINDOW_US, 0): 17_000,
        (od.SYNC_PERIOD_US, 0): 20_000,
        (od.HEARTBEAT_MS, 0): 100,
    }
    first = [(m.arbitration_id, bytes(m.data)) for m in bench.bus.sent[:2]]
    assert first == [(0, bytes([130, 5])), (0x605, bytes.fromhex("40 18 10 01 00 00 00 00"))]


@pytest.mark.parametrize("layout", [paper_layout(), pinch_layout()], ids=["paper", "pinch"])
def test_frames_come_at_the_rate_of_sync(make_bench, layout) -> None:
    bench = make_bench(layout)
    bench.unit.counts = np.arange(layout.n_taxels, dtype=np.uint16) % layout.adc_max
    bench.link.start()
    frames = bench.run(1.0)
    assert len(frames) == pytest.approx(50, abs=1)
    assert [frame.counter for frame in frames] == list(range(len(frames)))
    np.testing.assert_array_equal(frames[0].counts, bench.unit.counts)
    spacing_s = np.diff([frame.t_s for frame in frames])
    np.testing.assert_allclose(spacing_s, 0.02, atol=1e-9)
    statistics = bench.link.statistics
    assert (statistics.frames.complete, statistics.frames.lost) == (len(frames), 0)
    assert statistics.recent_loss_rate == 0.0
    assert statistics.foreign == statistics.malformed == statistics.late_syncs == 0
    assert bench.link.last_frame_s == frames[-1].t_s


def test_a_slow_caller_does_not_make_up_for_syncs_and_does_not_lose_the_link(bench) -> None:
    bench.link.start()
    bench.run(0.1)
    before = sync_times(bench)
    bench.clock.sleep(0.5)
    bench.link.poll()
    assert sync_times(bench) == before + 1
    assert bench.link.statistics.late_syncs == 1
    assert len(bench.run(0.2)) >= 10


def test_after_a_late_sync_the_next_one_does_not_cut_into_the_burst(bench) -> None:
    bench.link.start()
    bench.run(0.1)
    bench.clock.sleep(0.036)
    bench.link.poll()
    late, late_s = sync_times(bench), bench.clock.monotonic()
    while sync_times(bench) == late:
        bench.clock.sleep(0.001)
        bench.link.poll()
    assert bench.clock.monotonic() - late_s >= 0.018


# --- start-up refusals ---------------------------------------------------------------------------


def test_a_node_that_never_appears_is_missing_and_the_message_says_who_is_there(bench) -> None:
    bench.unit.alive = False
    bench.clock.on_advance.append(lambda now_s: bench.bus.put(0x706, b"\x7f"))
    start_s = bench.clock.now_s
    with pytest.raises(NodeMissing, match=r"within 3 s; node-IDs heard: 6"):
        bench.link.start()
    assert bench.clock.now_s - start_s == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize(
    ("knob", "value", "says"),
    [
        ("alive", False, "no node is heard"),
        ("heartbeats", False, "did not become operational"),
        ("boots", 2, "same node-ID"),
        ("mute_sdo", 1000, r"failed 3 times: no SDO response within 0.3 s"),
    ],
)
def test_a_unit_that_does_not_come_up_alone_is_a_missing_node(bench, knob, value, says) -> None:
    setattr(bench.unit, knob, value)
    with pytest.raises(NodeMissing, match=says):
        bench.link.start()


def test_a_unit_that_boots_late_is_waited_for(bench) -> None:
    bench.unit.alive = False

    def power_on(now_s: float) -> None:
        if now_s >= 101.5 and not bench.unit.alive:
            bench.unit.alive = True
            bench.unit.boot()

    bench.clock.on_advance.append(power_on)
    assert bench.link.start().serial == 4711


@pytest.mark.parametrize(
    ("entry", "value", "says"),
    [
        (
            (od.IDENTITY, 1),
            b"\1\0\0\0",
            r"vendor-ID: expected 21571 \(0x5443\), found 1",
        ),
        ((od.IDENTITY, 2), b"\2\0\0\0", "product code: expected 1032"),
        (
            (od.IDENTITY, 3),
            b"\0\0\2\0",
            r"major revision: expected 1 \(0x1\), found 2",
        ),
        (
            (od.LAYOUT, 3),
            b"0123456789abcdef",
            "layout hash: expected 48.*, found 0123456789abc",
        ),
        ((od.LAYOUT, 2), b"\x9c\0", "taxels: expected 408 .*found 156"),
        ((od.LAYOUT, 4), b"\xff\x0f", "full scale: expected 255 .*found 4095"),
        ((od.FORMAT, 2), b"\2", "sample bytes"),
        ((od.FORMAT, 3), b"\x33\0", "messages per frame: expected 59 .*found 51"),
        ((od.FORMAT, 4), b"\2", "header bytes"),
        ((od.TPDO1_MAPPING, 0), b"\0", "TPDO1 entries"),
        ((od.TPDO1_MAPPING, 2), b"\x40\0\0\x21", "TPDO1 entry 2"),
        ((od.TPDO1_PARAMETER, 1), b"\x85\1\0\x80", "TPDO1 COB-ID"),
    ],
)
def test_another_unit_is_refused_with_expected_and_found(bench, entry, value, says) -> None:
    bench.unit.objects[entry] = value
    with pytest.raises(IdentityMismatch, match=says):
        bench.link.start()
    assert bench.unit.state != 5
    assert sync_times(bench) == 0


def test_the_serial_number_tells_swapped_units_apart(make_bench) -> None:
    bench = make_bench(identity=ExpectedIdentity(serial=4712))
    with pytest.raises(IdentityMismatch, match="serial number: expected 4712"):
        bench.link.start()


def test_exchanged_pads_are_refused_by_the_serial_numbers_of_their_boards(make_bench) -> None:
    assert make_bench(identity=ExpectedIdentity(boards=(31, 32))).link.start().boards == (31, 32)
    with pytest.raises(IdentityMismatch, match="pads of the two fingers are exchanged"):
        make_bench(identity=ExpectedIdentity(boards=(32, 31))).link.start()
    with pytest.raises(IdentityMismatch, match=r"board of finger 1: expected 33 .* found 32"):
        make_bench(identity=ExpectedIdentity(boards=(31, 33))).link.start()


def test_a_unit_that_does_not_keep_its_set_up_is_refused(bench) -> None:
    def forget(index: int, sub: int, value: int, size: int) -> bytes:
        bench.unit.objects[index, sub] = (value // 2).to_bytes(size, "little")
        return bytes([0x60]) + index.to_bytes(2, "little") + bytes([sub, 0, 0, 0, 0])

    bench.unit.write = forget
    with pytest.raises(IdentityMismatch, match=r"heartbeat in ms: expected 100 .*found 50"):
        bench.link.start()


def test_an_object_that_is_missing_is_named(bench) -> None:
    del bench.unit.objects[od.LAYOUT, 3]
    with pytest.raises(NodeMissing, match=r"0x2100:03 .*refused.*Object does not exist"):
        bench.link.start()


def test_lost_sdo_responses_are_asked_for_again(bench) -> None:
    bench.unit.mute_sdo = 2
    assert bench.link.start().vendor_id == od.VENDOR_ID


def test_a_zero_held_by_the_unit_is_cleared(bench) -> None:
    bench.unit.objects[od.TARE, od.TARE_RESULT] = bytes([od.TareResult.DONE])
    bench.link.start()
    assert bench.unit.written[od.TARE, od.TARE_COMMAND] == od.TARE_CLEAR_SIGNATURE


# --- faults in operation -------------------------------------------------------------------------


def test_lost_heartbeat_is_a_fault_after_two_and_a_half_periods(bench) -> None:
    bench.link.start()
    bench.run(0.5)
    bench.unit.heartbeats = False
    last_s = bench.clock.now_s
    with pytest.raises(HeartbeatLost, match=r"allowed are 0.25 s"):
        bench.run(1.0)
    assert bench.clock.now_s - last_s <= 0.1 + 0.25 + 0.006


def test_a_heartbeat_with_a_turned_bit_is_counted_and_no_other_state(bench) -> None:
    bench.link.start()
    bench.run(0.1)
    bench.bus.put(0x700 + NODE, b"\x45")
    bench.run(0.05)
    assert bench.link.statistics.malformed == 1


@pytest.mark.parametrize(
    ("cob_id", "data", "error", "says"),
    [
        (0x700 + NODE, b"\0", NodeRebooted, "boot-up"),
        (0x700 + NODE, b"\x7f", NodeStateChanged, "pre-operational"),
        (0x700 + NODE, b"\4", NodeStateChanged, "stopped"),
        (0x40, bytes(8), BusOff, "bus-off"),
    ],
)
def test_a_message_that_ends_the_operation_is_a_fault(bench, cob_id, data, error, says) -> None:
    bench.link.start()
    bench.bus.put(cob_id, data, is_error_frame=error is BusOff)
    with pytest.raises(error, match=says):
        bench.link.poll()


def test_emergency_is_a_fault_with_its_text(bench) -> None:
    bench.link.start()
    bench.bus.put(0x80 + NODE, EMCY_STRUCT.pack(0xFF03, 0x81, bytes(5)))
    with pytest.raises(NodeEmergency, match=r"0xFF03 \(converter self-test failed\)") as caught:
        bench.link.poll()
    assert (caught.value.code, caught.value.register) == (0xFF03, 0x81)
    assert caught.value.text == "converter self-test failed"


def test_error_reset_and_short_emergencies_are_no_fault(bench) -> None:
    bench.link.start()
    bench.bus.put(0x80 + NODE, bytes(8))
    bench.bus.put(0x80 + NODE, b"\x10\x81")
    bench.link.poll()
    assert bench.link.statistics.malformed == 1


def test_error_passive_is_a_fault_when_it_lasts(bench) -> None:
    bench.link.start()
    bench.bus.put(0x04, bytes([0, 0x10, 0, 0, 0, 0, 0, 0]), is_error_frame=True)
    assert bench.run(0.45)
    bench.bus.put(0x04, bytes([0, 0x40, 0, 0, 0, 0, 0, 0]), is_error_frame=True)
    assert bench.run(1.0)
    bench.bus.put(0x04, bytes([0, 0x20, 0, 0, 0, 0, 0, 0]), is_error_frame=True)
    start_s = bench.clock.now_s
    with pytest.raises(BusErrorPassive, match=r"allowed are 0.5 s"):
        bench.run(1.0)
    assert bench.clock.now_s - start_s == pytest.approx(0.505, abs=0.01)
    assert bench.link.statistics.error_frames == 3


def test_no_frames_for_three_syncs_is_a_fault_within_60_ms(bench) -> None:
    bench.link.start()
    bench.run(0.2)
    lost_at_s = []

    def lose() -> None:
        lost_at_s.append(bench.clock.now_s)

    bench.unit.sync = lose
    with pytest.raises(FrameTimeout, match="after 3 SYNCs"):
        bench.run(1.0)
    assert len(lost_at_s) == 3
    assert bench.clock.now_s - lost_at_s[0] == pytest.approx(0.06)


def test_two_lost_frames_are_noted_only(bench) -> None:
    bench.link.start()
    bench.run(0.2)
    bench.unit.mute_syncs = 2
    frames = bench.run(0.2)
    assert len(frames) == 8
    assert bench.link.statistics.frames.lost == 2
    assert bench.link.statistics.recent_loss_rate == pytest.approx(2 / 20, abs=0.02)


def test_a_torn_frame_is_never_handed_out_and_frequent_loss_is_a_fault(bench) -> None:
    bench.link.start()
    bench.run(0.5)

    def lose_every_third(messages: list[bytes]) -> list[bytes]:
        return messages[:20] + messages[21:] if bench.unit.counter % 3 == 0 else messages

    bench.unit.alter = lose_every_third
    with pytest.raises(FrameTimeout, match=r"3 of the last 50 .* allowed are 5%"):
        bench.run(2.0)
    assert bench.link.statistics.frames.torn >= 2


def test_frames_without_crc_are_a_fault_in_the_end(bench) -> None:
    bench.link.start()
    bench.unit.alter = lambda messages: [*messages[:-1], messages[-1][:-1] + b"\0"]
    with pytest.raises(FrameTimeout):
        bench.run(1.0)
    assert bench.link.statistics.frames.corrupt >= 2


@pytest.mark.parametrize("error", [can.CanOperationError("gone"), OSError(5, "gone")])
def test_a_failing_interface_is_bus_off(bench, error) -> None:
    bench.link.start()
    bench.bus.incoming.append(error)
    with pytest.raises(BusOff, match=r"gone.*plugged in"):
        bench.link.poll()


def test_a_failing_send_is_bus_off(bench) -> None:
    bench.link.start()
    bench.bus.send_error = can.CanOperationError("no buffer space")
    with pytest.raises(BusOff, match="no buffer space"):
        bench.run(0.1)
    bench.link.close()


def test_foreign_remote_extended_and_damaged_messages_are_counted(bench) -> None:
    bench.link.start()
    bench.bus.put(0x7FF, b"")
    bench.bus.put(0x180 + NODE, b"", is_remote_frame=True)
    bench.bus.incoming.append(can.Message(arbitration_id=0x185, data=bytes(8), is_extended_id=True))
    bench.bus.put(0x80 + NODE, b"\1\2\3", dlc=8)
    bench.bus.put(0x180 + NODE, b"\1\2\3", dlc=8)
    bench.bus.put(0x700 + NODE, b"")
    assert len(bench.run(0.1)) == 5
    statistics = bench.link.statistics
    assert (statistics.foreign, statistics.malformed, statistics.frames.short) == (1, 4, 1)


def pour_garbage(bench, per_ms: int) -> None:
    rng = np.random.default_rng(8)

    def garbage(now_s: float) -> None:
        for _ in range(per_ms):
            cob_id = int(rng.integers(0, 0x800))
            if cob_id not in {0x80 + NODE, 0x700 + NODE}:
                bench.bus.put(cob_id, rng.bytes(int(rng.integers(0, 9))))

    bench.clock.on_advance.append(garbage)


def test_some_random_garbage_does_no_harm(bench) -> None:
    bench.link.start()
    pour_garbage(bench, 1)
    frames = bench.run(1.0)
    assert len(frames) >= 49
    assert all(not frame.counts.any() for frame in frames)
    assert bench.link.statistics.foreign > 900


def test_too_much_garbage_is_a_fault_within_60_ms(bench) -> None:
    bench.link.start()
    bench.run(0.1)
    start_s = bench.clock.now_s
    pour_garbage(bench, 8)
    with pytest.raises(BusDisturbed, match=r"unknown COB-IDs came within \d+ ms, allowed are 2000"):
        bench.run(1.0)
    assert bench.clock.now_s - start_s <= 0.06


def test_too_many_damaged_messages_are_a_fault(bench) -> None:
    bench.link.start()
    bench.run(0.1)
    bench.clock.on_advance.append(lambda now_s: bench.bus.put(0x80 + NODE, b"\x10\x81"))
    with pytest.raises(BusDisturbed, match=r"1\d damaged messages"):
        bench.run(1.0)


def test_frames_that_begin_to_come_late_are_a_fault(bench) -> None:
    """Late by two periods: each is whole, in order and counted, and yet too old for control."""
    bench.link.start()
    assert len(bench.run(0.2)) == 10
    late: list[tuple[float, list[bytes]]] = []

    def hold_back(messages: list[bytes]) -> list[bytes]:
        late.append((bench.clock.now_s + 0.045, messages))
        return []

    def deliver(now_s: float) -> None:
        while late and late[0][0] <= now_s:
            for data in late.pop(0)[1]:
                bench.bus.put(0x180 + NODE, data)

    bench.unit.alter = hold_back
    bench.clock.on_advance.append(deliver)
    start_s = bench.clock.now_s
    with pytest.raises(FrameTimeout, match="2 periods later than before, allowed are 1"):
        bench.run(1.0)
    assert bench.clock.now_s - start_s <= 0.11


def test_frames_that_come_late_once_catch_up(bench) -> None:
    bench.link.start()
    bench.run(0.2)
    held: list[bytes] = []

    def hold_back(messages: list[bytes]) -> list[bytes]:
        held.extend(messages)
        return []

    bench.unit.alter = hold_back
    bench.run(0.04)
    bench.unit.alter = lambda messages: held + messages
    bench.run(0.02)
    bench.unit.alter = lambda messages: messages
    bench.run(0.5)
    assert bench.link.statistics.frames.lost == 0


def test_a_sync_that_the_unit_did_not_hear_is_forgotten_in_time(bench) -> None:
    """One a minute is noise; two in a row within seconds look like frames that come late."""
    bench.link.start()
    bench.run(0.2)
    hear = bench.unit.sync

    def miss_one() -> None:
        bench.unit.sync = hear

    for _ in range(2):
        bench.unit.sync = miss_one
        assert len(bench.run(12.0)) >= 595
    bench.unit.sync = miss_one
    bench.run(0.2)
    bench.unit.sync = miss_one
    with pytest.raises(FrameTimeout, match="SYNCs do not reach the unit"):
        bench.run(0.2)


# --- a second unit with the same node-ID ---------------------------------------------------------


def double(bench, cob_id: int, *, times: float = np.inf) -> None:
    """Let messages of an identifier come twice, so many of them."""
    put, left = bench.bus.put, times

    def twice(found: int, data: bytes, **options: object) -> None:
        nonlocal left
        put(found, data, **options)
        if found == cob_id and left > 0:
            left -= 1
            put(found, data, **options)

    bench.bus.put = twice


def test_two_answers_to_each_sdo_request_are_refused(bench) -> None:
    double(bench, 0x580 + NODE)
    with pytest.raises(DuplicateNode, match="3 SDO answers more"):
        bench.link.start()


def test_one_sdo_answer_that_comes_twice_is_no_second_unit(bench) -> None:
    double(bench, 0x580 + NODE, times=1)
    assert bench.link.start().serial == 4711


def test_doubled_heartbeats_are_a_second_unit(bench) -> None:
    bench.link.start()
    bench.run(0.2)
    double(bench, 0x700 + NODE)
    start_s = bench.clock.now_s
    with pytest.raises(DuplicateNode, match="16 heartbeats"):
        bench.run(2.0)
    assert bench.clock.now_s - start_s <= 1.0


@pytest.mark.parametrize("other_content", [False, True])
def test_two_bursts_after_each_sync_are_a_second_unit(bench, other_content) -> None:
    bench.unit.noisy = True
    bench.link.start()
    bench.run(0.2)

    def both(messages: list[bytes]) -> list[bytes]:
        second = bench.unit.frame() if other_content else messages
        return [data for pair in zip(messages, second, strict=True) for data in pair]

    bench.unit.alter = both
    start_s = bench.clock.now_s
    with pytest.raises(DuplicateNode, match=r"118 frame messages .* sends 59: a second unit"):
        bench.run(1.0)
    assert bench.clock.now_s - start_s <= 0.105


def test_bursts_that_pile_up_behind_a_stall_are_no_second_unit() -> None:
    flow = FrameFlow(
        "the unit",
        timeout_periods=100,
        max_loss_rate=0.05,
        window_frames=50,
        late_periods=100,
        burst_messages=59,
    )
    rng, waiting, counter = np.random.default_rng(4), 0, 0
    for _ in range(2000):
        flow.before_sync()
        waiting += 1
        if rng.random() < 0.5:
            flow.messages(59 * waiting)
            for _ in range(waiting):
                flow.on_frame(counter)
                counter += 1
            waiting = 0


def test_every_third_message_twice_is_noted_only(bench) -> None:
    bench.link.start()
    bench.unit.alter = lambda messages: sorted(messages + messages[::3], key=messages.index)
    assert len(bench.run(1.0)) >= 49
    assert bench.link.statistics.frames.duplicate >= 900


# --- latching and life cycle ---------------------------------------------------------------------


def test_a_fault_latches_until_closed_and_started_again(bench) -> None:
    bench.link.start()
    bench.unit.boot()
    with pytest.raises(NodeRebooted):
        bench.link.poll()
    bench.unit.state = 5
    syncs = sync_times(bench)
    for _ in range(3):
        bench.clock.sleep(0.02)
        with pytest.raises(NodeRebooted):
            bench.link.poll()
        with pytest.raises(NodeRebooted):
            bench.link.read_last_frame()
    assert isinstance(bench.link.fault, NodeRebooted)
    assert sync_times(bench) == syncs
    bench.link.close()
    bench.link.start()
    assert bench.link.fault is None
    assert len(bench.run(0.2)) == 10


def test_calls_out_of_order_are_refused(bench) -> None:
    with pytest.raises(LinkStateError, match="start it first"):
        bench.link.poll()
    bench.link.start()
    with pytest.raises(LinkStateError, match="close it"):
        bench.link.start()
    bench.link.close()
    bench.link.close()
    assert bench.unit.state == 127
    with pytest.raises(LinkStateError):
        bench.link.poll()


def test_a_failed_start_can_be_repeated_after_close(bench) -> None:
    bench.unit.alive = False
    with pytest.raises(NodeMissing):
        bench.link.start()
    bench.unit.alive = True
    bench.link.close()
    assert bench.link.start().serial == 4711


# --- services ------------------------------------------------------------------------------------


def test_last_frame_by_sdo_is_the_frame_by_pdo_and_frames_go_on(bench) -> None:
    bench.unit.noisy = True
    bench.link.start()
    bench.run(0.1)
    bench.unit.noisy = False
    bench.unit.counts = np.arange(408, dtype=np.uint16) % 250
    frames = bench.run(0.1)
    counter, counts = bench.link.read_last_frame()
    np.testing.assert_array_equal(counts, bench.unit.counts)
    frames += bench.link.poll()
    frames += bench.run(0.1)
    counters = [frame.counter for frame in frames]
    assert counters == list(range(counters[0], counters[-1] + 1))
    assert counter in counters


def test_last_frame_of_wrong_size_is_refused(bench) -> None:
    bench.link.start()
    bench.unit.objects[od.LAST_FRAME, 0] = bytes(100)
    bench.unit.frame = lambda: []
    with pytest.raises(FrameError, match="100 bytes, expected 408"):
        bench.link.read_last_frame()


def test_unit_tare(bench) -> None:
    bench.link.start()
    bench.link.tare_unit()
    assert bench.unit.written[od.TARE, od.TARE_COMMAND] == int.from_bytes(b"tare", "little")


def test_unit_tare_refused_is_told_with_the_largest_sample(bench) -> None:
    bench.link.start()
    bench.unit.tare_result = od.TareResult.REFUSED_TOUCHED
    with pytest.raises(TareRefused, match="touched, largest sample 93 counts"):
        bench.link.tare_unit()
    assert bench.link.fault is None


def test_unit_tare_that_does_not_end_is_given_up(bench) -> None:
    bench.link.start()
    bench.unit.tare_polls = 10**6
    start_s = bench.clock.now_s
    with pytest.raises(TareRefused, match="within 1 s"):
        bench.link.tare_unit(timeout_s=1.0)
    assert bench.clock.now_s - start_s == pytest.approx(1.0, abs=0.05)


# --- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"sync_period_s": 0.0},
        {"sync_window_s": 0.03},
        {"heartbeat_s": 100.0},
        {"heartbeat_factor": 0.9},
        {"startup_timeout_s": 0.0},
        {"frame_timeout_periods": 0},
        {"max_loss_rate": 1.5},
        {"sdo_timeout_s": float("nan")},
    ],
)
def test_settings_out_of_range_are_refused(change) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(change))} is .*must be"):
        LinkSettings(**change)


def test_the_window_follows_the_period() -> None:
    assert LinkSettings(sync_period_s=0.01).window_s == pytest.approx(0.0085)
    assert LinkSettings(sync_window_s=0.012).window_s == 0.012


@pytest.mark.parametrize("node_id", [0, 128])
def test_node_id_out_of_range_is_refused(bench, node_id) -> None:
    with pytest.raises(ValueError, match="1 to 127"):
        TactileLink(bench.bus, node_id=node_id, layout=paper_layout(), clock=bench.clock)
