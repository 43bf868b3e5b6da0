"""The link: start-up, frames, force messages, turned pads, every fault of the unit, its EDS."""

import itertools
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import can
import numpy as np
import pytest

import motion.object_dictionary
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.link import mean_bits
from simulator.can.scanner import read_zero
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.pads import PadPair
from tactile import errors
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.node import Mounting, TactileLink
from tactile.control_unit.search import listen
from tactile.control_unit.settings import LinkSettings, bus_load, least_sync_period_s, message_bits
from tactile.control_unit.watch import FrameFlow, NodeWatch, emergency_text
from tactile.frames import FrameFormat, encode_zero, force_table
from tactile.layout import PadMount, paper_layout, pinch_layout, taxel_order
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.opening import open_sensor
from tactile.source import ForceMessage, PadZero, ScanStatus, SourceStatistics
from tests.tactile.conftest import Bench

NODE = 5
OVERFLOW = "Synchronous counter overflow value"
FRAMES_TYPE = (
    "TPDO1 communication parameter.Transmission type (manufacturer-specific: burst after SYNC)"
)
FOREIGN = ({"is_extended_id": True}, {"is_remote_frame": True})
"""Frames that CANopen does not use."""


def written(bench) -> dict[tuple[int, int], int]:
    """Return what the host has written by expedited downloads, by index and sub-index."""
    sent = [data for _, can_id, data in bench.traffic if can_id == 0x605 and data[0] >> 5 == 1]
    return {struct.unpack_from("<HB", data, 1): int.from_bytes(data[4:], "little") for data in sent}


def test_start_checks_configures_and_starts_the_unit(idle) -> None:
    identity = idle.link.start()
    assert (identity.serial, identity.name) == (4711, "Tactile control unit")
    idle.run(0.001, 0.001)
    assert [data[0] for _, can_id, data in idle.traffic if can_id == 0] == [130, 1]
    assert written(idle) == {
        (0x1005, 0): 0x80,
        (0x1007, 0): 17_000,
        (0x1006, 0): 20_000,
        (0x1017, 0): 100,
    }
    first = [(can_id, data) for _, can_id, data in idle.traffic if can_id in (0, 0x605)][:2]
    assert first == [(0, bytes([130, 5])), (0x605, bytes.fromhex("40 18 10 01 00 00 00 00"))]


def test_a_slow_caller_does_not_make_up_for_syncs_and_does_not_lose_the_link(bench) -> None:
    bench.run(0.1)
    before = bench.link.statistics.requests
    bench.clock.sleep(0.5)
    bench.link.poll()
    assert (bench.link.statistics.requests, bench.link.statistics.late_requests) == (before + 1, 1)
    assert len(bench.run(0.2)) >= 10


def test_after_a_late_sync_the_next_one_does_not_cut_into_the_burst(bench) -> None:
    bench.run(0.1)
    bench.clock.sleep(0.036)
    bench.link.poll()
    late, late_s = bench.link.statistics.requests, bench.clock.monotonic()
    while bench.link.statistics.requests == late:
        bench.clock.sleep(0.001)
        bench.link.poll()
    assert bench.clock.monotonic() - late_s >= 0.018


# --- start-up refusals ---------------------------------------------------------------------------


def test_a_node_that_never_appears_is_missing_and_the_message_says_who_is_there(idle) -> None:
    idle.unit.faults.dead = True
    idle.clock.on_advance.append(lambda now_s: idle.put(0x706, b"\x7f"))
    start_s = idle.clock.monotonic()
    with pytest.raises(errors.NodeMissing, match=r"within 3 s; node-IDs heard: 6"):
        idle.link.start()
    assert idle.clock.monotonic() - start_s == pytest.approx(3.0, abs=0.01)
    idle.unit.faults.dead = False
    idle.link.stop()
    assert idle.link.start().serial == 4711


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda bench: setattr(bench.unit.faults, "dead", True), "no node is heard"),
        (
            lambda bench: setattr(bench.unit.faults, "heartbeat_off", True),
            "did not become operational",
        ),
        (lambda bench: copy(bench, 0x700 + NODE, 2, times=1), "same node-ID"),
        (lambda bench: copy(bench, 0x580 + NODE, 0), "3 times: no SDO response within 0.3 s"),
        (
            lambda bench: bench.alter(0x580 + NODE, lambda burst: [data[:3] for data in burst]),
            r"answer \[43 18 10\] has 3 bytes, expected 8; update the unit's firmware",
        ),
    ],
)
def test_a_unit_that_does_not_come_up_alone_is_a_missing_node(idle, spoil, says) -> None:
    spoil(idle)
    with pytest.raises(errors.NodeMissing, match=says):
        idle.link.start()


@pytest.mark.parametrize(
    ("size", "segments", "says"),
    [
        (0, ["00", "10"] * 7 + ["00"], "does not end after 15 responses"),
        (20, ["0d"], "1 bytes came, the object has 4"),
    ],
)
def test_an_object_without_its_end_is_given_up(idle, monkeypatch, size, segments, says) -> None:
    monkeypatch.setattr("tactile.can.sdo_client._MOST_RESPONSES", 15)
    heads = [struct.pack("<BHBL", 0x41, 0x1018, 1, size), *map(bytes.fromhex, segments)]
    answers = itertools.cycle(head.ljust(8, b"\0") for head in heads)
    idle.alter(0x580 + NODE, lambda _burst: [next(answers)])
    with pytest.raises(errors.NodeMissing, match=says):
        idle.link.start()


def test_a_boot_up_without_data_is_used(idle) -> None:
    idle.alter(0x700 + NODE, lambda burst: [data.lstrip(b"\0") for data in burst])
    idle.link.start()
    idle.run(0.2)
    assert idle.link.statistics.malformed == 0
    idle.unit.power_cycle()
    with pytest.raises(errors.NodeRebooted, match="sent a boot-up message"):
        idle.run(0.2)


def boot_late(bench) -> None:
    """Switch the unit off, and on again in 1.5 s."""
    bench.unit.faults.dead = True

    def power_on(now_s: float) -> None:
        if now_s >= 101.5 and bench.unit.faults.dead:
            bench.unit.faults.dead = False
            bench.unit.power_cycle()

    bench.clock.on_advance.append(power_on)


@pytest.mark.parametrize(
    "change",
    [
        boot_late,
        lambda bench: copy(bench, 0x580 + NODE, 2, times=1),
        lambda bench: setattr(bench.unit, "_missing", {0x1019}),
    ],
    ids=["late boot", "one SDO answer twice", "no object 1019h"],
)
def test_a_unit_that_differs_a_little_is_started(idle, change) -> None:
    change(idle)
    assert idle.link.start().serial == 4711


@pytest.mark.parametrize(
    ("entry", "value", "says"),
    [
        ("Identity object.Vendor-ID", 1, r"vendor-ID: expected 21571 \(0x5443\), found 1"),
        ("Identity object.Product code", 2, "product code: expected 1032"),
        ("Identity object.Revision number", 0x2_0000, r"major revision: expected 1 .*found 2"),
        ("Identity object.Serial number", 4712, "serial number: expected 4711"),
        ("Taxel layout.Layout hash", "0123456789abcdef", "expected 48.*found 0123456789abc"),
        ("Taxel layout.Number of taxels", 156, "expected 408 .*found 156"),
        ("Taxel layout.Full scale of the counts", 4095, "expected 255 .*found 4095"),
        ("Frame format.Sample bytes", 2, "Sample bytes"),
        ("Frame format.Messages per frame", 51, r"per frame \(2101h:03\): expected 59 .*51"),
        ("Frame format.Header bytes", 2, "Header bytes"),
        ("TPDO1 mapping parameter.Highest sub-index supported", 0, r"\(1A00h:00\)"),
        ("TPDO1 mapping parameter.Mapped object 2", 0x2100_0040, r"object 2 \(1A00h:02\)"),
        ("TPDO1 mapping parameter.Mapped object 1", 0x6110_0108, r"\(1A00h:01\)"),
        (od.FRAMES_COB_ID, 0x8000_0185, "COB-ID used by TPDO1"),
        (od.FRAMES_COB_ID, 0x2000_0185, r"\(1800h:01\): expected 389 .*0x20000185"),
        (FRAMES_TYPE, 1, r"\(1800h:02\): expected 254 .*, store"),
        (OVERFLOW, 10, r"expected 0 .*found 10 .*1006h is 0"),
        ("Producer heartbeat time", 50, r"\(1017h:00\): expected 100 .*found 50"),
    ],
)
def test_another_unit_is_refused_with_expected_and_found(make_bench, entry, value, says) -> None:
    bench = make_bench(unit=ControlUnitSettings(serial_number=4711), serial=4711)
    bench.unit.pretend(entry, value)
    with pytest.raises(errors.IdentityMismatch, match=says):
        bench.link.start()
    assert (bench.unit.nmt_state, bench.link.statistics.requests) == ("PRE-OPERATIONAL", 0)


def test_a_unit_that_forbids_requests_of_its_frames_is_the_same(make_bench) -> None:
    bench = make_bench()
    bench.unit.pretend(od.FRAMES_COB_ID, 0x4000_0185)
    bench.link.start()


def test_exchanged_pads_are_refused_by_the_serial_numbers_of_their_boards(make_bench) -> None:
    assert make_bench(boards=(1, 2)).link.start().boards == (1, 2)
    with pytest.raises(errors.IdentityMismatch, match="pads of the two fingers are exchanged"):
        make_bench(boards=(2, 1)).link.start()
    with pytest.raises(errors.IdentityMismatch, match=r"board of finger 1: expected 3 .* found 2"):
        make_bench(boards=(1, 3)).link.start()


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (0x0503_0000, "SDO toggle bit error.*another program may use the unit"),
        (0x0800_0022, ".*present device state.*restart the unit"),
        (0x0602_0000, "Object does not exist.*update the older one"),
    ],
)
def test_an_object_that_the_unit_refuses_is_named_with_the_abort_in_words(idle, code, says) -> None:
    idle.alter(0x580 + NODE, lambda _burst: [struct.pack("<BHBL", 0x80, 0x1018, 1, code)])
    with pytest.raises(
        errors.ObjectRefused, match=rf"0x1018:01 .*refused \(Code 0x{code:08X}, {says}"
    ):
        idle.link.start()


@pytest.mark.parametrize(("first", "last"), [(0, 1), (66, 66), (140, 140)])
def test_lost_sdo_responses_are_asked_for_again_and_hide_no_second_unit(
    make_forces, first: int, last: int
) -> None:
    idle, answers = make_forces(), itertools.count()
    idle.alter(0x580 + NODE, lambda burst: [] if first <= next(answers) <= last else burst)
    assert idle.link.start().vendor_id == od.VENDOR_ID
    assert next(answers) > last
    idle.link.stop()
    copy(idle, 0x580 + NODE, 0, times=2)
    copy(idle, 0x580 + NODE, 2, times=7)
    with pytest.raises(errors.DuplicateNode, match="3 SDO answers more"):
        idle.link.start()


@pytest.mark.parametrize(("kind", "nodes"), [({}, (6,)), (FOREIGN[0], ()), (FOREIGN[1], ())])
def test_a_search_finds_the_nodes_of_plain_messages_alone(idle, kind, nodes) -> None:
    idle.clock.on_advance.append(lambda _now_s: idle.put(0x706, b"", **kind))
    assert listen(idle.bus, 0.05).nodes == nodes


# --- faults in operation -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cob_id", "data", "fault", "text"),
    [
        (0x700, b"\4", errors.NodeStateChanged, "stopped"),
        (0x80, b"\x20\x81\x11\0\0\0\0\0", errors.NodeEmergency, r"0x8120 \([^;]*\), .* 0x11"),
        (0x80, b"\x20\x81\x11", errors.NodeEmergency, r"0x8120 \(.*; only 3 of 8 .*register 0x11"),
        (0x80, b"\x20\x81", errors.NodeEmergency, r"0x8120 \(.*; only 2 of 8 .*register 0x00"),
    ],
)
def test_a_stopped_unit_or_its_emergency_is_a_fault(bench, cob_id, data, fault, text) -> None:
    bench.put(cob_id + NODE, data)
    with pytest.raises(fault, match=text):
        bench.link.poll()


@pytest.mark.parametrize("error", [can.CanOperationError("gone"), OSError(5, "gone")])
@pytest.mark.parametrize("call", ["_recv_all", "send"])
def test_a_failing_interface_is_bus_off(bench, monkeypatch, error, call) -> None:
    owner = bench.bus if call == "send" else bench.link._source
    monkeypatch.setattr(owner, call, Mock(side_effect=error))
    with pytest.raises(errors.BusOff, match=r"gone.*plugged in"):
        bench.run(0.1)
    bench.link.fault = errors.NodeEmergency("older")
    bench.link.stop()
    assert (call == "send") is isinstance(bench.link.fault, errors.BusOff)


def test_foreign_and_damaged_messages_are_counted_and_an_error_reset_is_neither(bench) -> None:
    bench.put(0x700 + NODE, b"\x45")  # no state
    bench.put(0x80 + NODE, bytes(8))
    bench.put(0x80 + NODE, bytes(2))
    bench.put(0x80 + NODE, b"\x10")  # half a code
    bench.put(0x7FF, b"")
    bench.put(0x180 + NODE, b"", is_remote_frame=True)
    bench.put(0x180 + NODE, bytes(8), is_extended_id=True)
    bench.put(0x80 + NODE, b"\1", dlc=8)
    bench.put(0x180 + NODE, b"\1\2\3", dlc=8)
    bench.put(0x180 + NODE, b"\1\2\3")
    assert len(bench.run(0.1)) == 5
    statistics = bench.link.statistics
    assert (statistics.foreign, statistics.malformed, statistics.frames.short) == (3, 4, 1)


@pytest.mark.parametrize("kind", FOREIGN)
def test_messages_of_another_kind_are_limited_as_foreign_ones(make_bench, kind) -> None:
    bench = make_bench(max_foreign_hz=1000.0)
    bench.link.start()
    for _ in range(50):
        bench.put(0x700 + NODE, b"", **kind)
    bench.run(0.1)
    for _ in range(51):
        bench.put(0x700 + NODE, b"", **kind)
    with pytest.raises(
        errors.BusDisturbed, match=r"51 messages of other nodes.* raise tactile\.foreign"
    ):
        bench.run(0.1)


def test_too_many_damaged_lines_of_a_serial_adapter_are_a_fault(bench, monkeypatch) -> None:
    bench.run(0.1)
    lines = itertools.count()
    monkeypatch.setattr("tactile.control_unit.node.bad_lines", lambda _bus: next(lines))
    with pytest.raises(errors.BusDisturbed, match=r"1\d damaged messages"):
        bench.run(1.0)


@pytest.mark.slow
def test_a_sync_that_the_unit_did_not_hear_is_forgotten_in_time(bench) -> None:
    """One a minute is noise; two in a row within seconds look like frames that come late."""
    bench.run(0.2)
    hear = bench.unit.receive

    def miss_one(can_id: int, data: bytes, now_s: float) -> None:
        if can_id == 0x80:
            bench.unit.receive = hear
        else:
            hear(can_id, data, now_s)

    for _ in range(2):
        bench.unit.receive = miss_one
        assert len(bench.run(12.0)) >= 595
    bench.unit.receive = miss_one
    bench.run(0.2)
    bench.unit.receive = miss_one
    with pytest.raises(errors.FrameTimeout, match="SYNCs do not reach the unit"):
        bench.run(0.2)


# --- a second unit with the same node-ID ---------------------------------------------------------


def copy(bench, cob_id: int, n: int, *, times: float = np.inf) -> None:
    """Let bursts of an identifier come ``n`` times, 0: not at all, so many of them."""
    left = itertools.count(times, -1)
    bench.alter(cob_id, lambda burst: burst * n if next(left) > 0 else burst)


def test_bursts_that_pile_up_behind_a_stall_are_no_second_unit() -> None:
    flow = FrameFlow("the unit", LinkSettings(silence_s=2.0), 59)
    rng, waiting = np.random.default_rng(4), 0
    for _ in range(2000):
        flow.before_sync()
        waiting += 1
        if rng.random() < 0.5:
            flow.messages += 59 * waiting
            for _ in range(waiting):
                flow.on_frame(0)
            waiting = 0


@pytest.mark.parametrize("every", [5, 18, 21])
def test_lost_frames_are_a_fault_with_the_one_that_is_too_many(every: int) -> None:
    flow, lost = FrameFlow("the unit", LinkSettings(), 59), 0

    def lose() -> None:
        nonlocal lost
        for number in range(1, 1000):
            if number % every == 0:
                lost += 1
            else:
                flow.on_frame(lost)

    too_many = pytest.raises(errors.FrameTimeout, match=r"11 of the last 200 frames .* are 5%")
    with too_many if every < 20 else nullcontext():
        lose()
    assert every > 20 or lost == 11


# --- latching and life cycle ---------------------------------------------------------------------


def test_a_fault_latches_until_closed_and_started_again(bench) -> None:
    bench.unit.power_cycle()
    with pytest.raises(errors.NodeRebooted):
        bench.run(0.1)
    bench.unit.command("OPERATIONAL", bench.clock.monotonic())
    syncs = bench.link.statistics.requests
    for _ in range(3):
        bench.clock.sleep(0.02)
        with pytest.raises(errors.NodeRebooted):
            bench.link.poll()
    assert isinstance(bench.link.fault, errors.NodeRebooted)
    assert bench.link.statistics.requests == syncs
    bench.link.stop()
    bench.link.start()
    assert bench.link.fault is None
    assert len(bench.run(0.2)) == 10


def test_a_second_start_is_refused_and_a_stop_leaves_the_unit_pre_operational(bench) -> None:
    with pytest.raises(errors.LinkStateError, match="stop it"):
        bench.link.start()
    bench.link.stop()
    assert bench.unit.nmt_state == "PRE-OPERATIONAL"
    with pytest.raises(errors.LinkStateError, match="start it first"):
        bench.link.poll()


# --- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"sync_period_s": 0.0},
        {"heartbeat_s": 100.0},
        {"startup_timeout_s": 0.0},
        {"max_loss_rate": 1.5},
        {"sdo_timeout_s": float("nan")},
        {"force_period_s": 0.0025},
    ],
)
def test_settings_out_of_range_are_refused(change) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(change))} is .*must be"):
        LinkSettings(**change)


@pytest.mark.parametrize("node_id", [0, 128])
def test_node_id_out_of_range_is_refused(idle, node_id) -> None:
    with pytest.raises(ValueError, match="1 to 127"):
        TactileLink(idle.bus, node_id=node_id, layout=paper_layout())


# --- the EDS by an independent checker, the load of the bus, texts --------------------------------


@pytest.mark.parametrize("eds", [od.EDS_PATH, motion.object_dictionary.EDS_PATH])
def test_dcfchk_finds_nothing(eds) -> None:
    checker = Path(sys.executable).with_name("dcfchk")
    done = subprocess.run(
        [checker, "-n", "5", eds], capture_output=True, text=True, check=False, timeout=30
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_defaults_of_the_eds_are_those_of_the_papers_layout() -> None:
    dictionary, layout = od.of_node(5), paper_layout()
    form = FrameFormat.of(layout)
    defaults = [
        [dictionary[index][sub].default for sub in (1, 2, 3, 4)]
        for index in (0x1018, 0x2100, 0x2101)
    ]
    assert defaults == [
        [od.VENDOR_ID, od.PRODUCT_CODE, od.REVISION, 1],
        [layout.n_pads, layout.n_taxels, layout.layout_hash, layout.adc_max],
        [layout.sample_bits, layout.sample_bits // 8, form.n_messages, form.header_bytes],
    ]
    assert dictionary[0x1014].default == 0x85


QUIET = LinkSettings(force_period_s=0.0, heartbeat_s=10.0)


@pytest.mark.parametrize(("n_bytes", "bits"), [(0, 55), (4, 95), (8, 135)])
def test_a_message_has_the_bits_of_the_standard_at_most(n_bytes: int, bits: int) -> None:
    assert message_bits(n_bytes) == bits
    assert mean_bits(bytes(n_bytes)) <= bits


@pytest.mark.parametrize(
    ("period_s", "bitrate", "share"),
    [(0.01, 1_000_000, 0.80), (0.02, 1_000_000, 0.40), (0.02, 500_000, 0.80)],
)
def test_the_frames_of_408_taxels_load_the_bus(period_s: float, bitrate: int, share: float) -> None:
    settings = replace(QUIET, sync_period_s=period_s)
    assert bus_load(paper_layout(), settings, bitrate) == pytest.approx(share, abs=0.005)


def test_force_messages_alone_may_be_too_many() -> None:
    settings = LinkSettings(force_period_s=0.001)
    assert least_sync_period_s(paper_layout(), settings, 125_000) == float("inf")


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8130, "monitoring"),
        (0x4212, "temperature"),
        (0xFF01, "a burst was cut short, it does not fit into the synchronous window"),
        (0xFF77, "device specific"),
        (0xAB00, "unknown code"),
    ],
)
def test_texts(code: int, text: str) -> None:
    assert emergency_text(code) == text


def test_restart_of_the_controller_ends_error_passive() -> None:
    counts = SourceStatistics()
    watch = NodeWatch("the unit", LinkSettings(), counts)
    watch.on_error_frame(0x04, bytes([0, 0x30]), 1.0)
    watch.on_error_frame(0x100, b"", 1.2)
    watch.check(2.0, 0)
    watch.on_error_frame(0x04, bytes([0, 0x10]), 3.0)
    watch.on_error_frame(0x04, bytes([0, 0x10]), 3.4)
    watch.on_error_frame(0x04, b"", 3.4)
    with pytest.raises(errors.BusErrorPassive, match=r"0\.50 s"):
        watch.check(3.5, 0)
    assert counts.error_frames == 5


# -- Force messages on the link, and pads that sit otherwise: set-up, order, what goes wrong -------


LAYOUT = paper_layout()
TABLE = force_table(LAYOUT, FoamCalibration(255).force_n)
ZERO = PadZero(offset_counts=np.zeros(128), touch_counts=4.0, bad=np.zeros(128, dtype=np.bool_))


@pytest.fixture
def make_forces(make_bench: Callable[..., Bench]) -> Callable[..., Bench]:
    """Return what makes a bench whose unit sends its force each 3 ms."""
    return partial(make_bench, law=FoamCalibration(255).force_n, force_period_s=0.003)


def started(bench: Bench) -> Bench:
    assert bench.link.start().sends_forces
    bench.link.set_zero(ZERO)
    return bench


@pytest.fixture
def sending(make_forces: Callable[..., Bench]) -> Bench:
    return started(make_forces())


def test_the_force_comes_by_table_and_zero_each_three_milliseconds(sending) -> None:
    sending.skin.counts[:] = 20
    sending.forces(0.1)
    messages = sending.forces(0.3)
    assert len(messages) == pytest.approx(100, abs=1)
    taxel_n = float(FoamCalibration(255).force_n(np.array([20.0]))[0])
    assert messages[-1].force_n == pytest.approx((64 * taxel_n, 64 * taxel_n), rel=0.01)
    assert messages[-1].status == ScanStatus.ZEROED
    assert np.diff([message.t_s for message in messages]).max() < 0.0035
    assert sending.link.statistics.forces.lost == 0


def test_messages_that_a_gateway_delays_are_refused_before_the_set_up(make_forces) -> None:
    bench = make_forces()
    bench.bus.faults.delay_s = 0.03
    with pytest.raises(errors.FrameTimeout, match=r"answers after 31 ms, allowed .* are 15 ms"):
        bench.link.start()
    assert bench.clock.monotonic() < 103.0
    bench.bus.faults.delay_s = 0.005
    bench.link.stop()
    assert started(bench).forces(0.3)


def test_a_force_message_waits_for_one_message_of_a_burst_and_no_more(sending) -> None:
    sending.traffic.clear()
    frames = sending.run(0.3, 0.001)
    ends_s = [t_s for t_s, can_id, _ in sending.traffic if can_id == 0x285]
    assert len(frames) >= 14
    assert np.abs(np.diff(ends_s) - 0.003).max() < 0.00026


def test_a_unit_without_force_messages_runs_as_before(make_forces) -> None:
    sending = make_forces(unit=ControlUnitSettings(force_messages=False))
    assert not sending.link.start().sends_forces
    assert sending.forces(0.2) == []
    assert sending.link.statistics.frames.complete >= 9
    assert {can_id for _, can_id, _ in sending.traffic} >= {0x185}


def test_a_table_that_the_unit_does_not_keep_is_refused(make_forces) -> None:
    sending = make_forces()
    sending.unit.pretend(od.FORCE_TABLE, TABLE[:-2] + b"\0\0")
    with pytest.raises(errors.IdentityMismatch, match="Table of counts to force"):
        sending.link.start()


@pytest.mark.parametrize(
    ("key", "value_s", "allowed_s"), [("sync_period_s", 0.05, 0.1), ("force_period_s", 0.05, 0.2)]
)
def test_two_frames_or_four_messages_may_be_missing(key, value_s, allowed_s) -> None:
    assert LinkSettings(**{key: value_s}).force_timeout_s == pytest.approx(allowed_s)


@pytest.mark.parametrize(("knob", "silence_s"), [("forces_off", 0.2), ("dead", 0.2)])
def test_a_longer_silence_is_allowed_where_that_is_set(make_forces, knob, silence_s) -> None:
    sending = started(make_forces(silence_s=silence_s, heartbeat_s=1.0))
    sending.forces(0.1)
    setattr(sending.unit.faults, knob, True)
    sending.forces(silence_s - 0.04)
    with pytest.raises(errors.FrameTimeout, match=r"no (force message|whole frame)"):
        sending.forces(0.08)


def test_too_many_old_force_messages_are_a_fault(sending) -> None:
    """Each second one comes before the one that was made earlier."""
    held: list[bytes] = []

    def later(burst: list[bytes]) -> list[bytes]:
        held.extend(burst)
        return [held.pop(), held.pop()] if len(held) == 2 else []

    sending.forces(0.1)
    sending.alter(0x285, later)
    with pytest.raises(errors.BusDisturbed, match="force messages that are older than"):
        sending.forces(1.0)


def stall(sending: Bench, monkeypatch: pytest.MonkeyPatch, stall_s: float = 0.057) -> None:
    """Stand still, and then find nothing: the thread that receives stood still, too."""
    with monkeypatch.context() as asleep:
        asleep.setattr(sending.link._source, "drain", lambda: [])
        sending.clock.sleep(stall_s)
        sending.link.poll()


def test_a_stall_of_the_host_is_no_silence_of_the_unit(make_forces, monkeypatch) -> None:
    sending = started(make_forces(heartbeat_s=0.02))
    for _ in range(5):
        sending.forces(0.1)
        stall(sending, monkeypatch)
        assert sending.forces(0.02)


@pytest.mark.parametrize("stall_s", [0.057, 0.115, 0.16])
def test_what_came_in_a_stall_of_the_host_is_not_late(sending, monkeypatch, stall_s) -> None:
    source = sending.link._source
    drain = source.drain
    # The thread that receives stamps what it reads at the end of the stall.
    monkeypatch.setattr(
        source, "drain", lambda: [(sending.clock.monotonic(), m) for _, m in drain()]
    )
    for _ in range(3):
        sending.forces(0.3)
        sending.clock.sleep(stall_s)
        sending.link.poll()
    assert sending.forces(0.3)


@pytest.mark.parametrize(("knob", "limit_s"), [("forces_off", 0.04), ("heartbeat_off", 0.25)])
def test_a_silent_unit_is_found_within_its_limit_and_the_stall(
    sending, monkeypatch, knob, limit_s
) -> None:
    sending.forces(0.1)
    start_s = sending.clock.monotonic()
    setattr(sending.unit.faults, knob, True)
    sending.forces(0.01)
    stall(sending, monkeypatch)
    with pytest.raises(errors.LinkFault, match=r"no (force message|heartbeat) from"):
        sending.forces(1.0)
    assert sending.clock.monotonic() - start_s < limit_s + 0.057 + 0.002


# -- Pads that sit otherwise -----------------------------------------------------------------------


PINCH = pinch_layout()
EXCHANGED = (PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0))
TURNED = tuple(
    PadMount(pad=pad, sent_as=pad, rows_mirrored=True, columns_mirrored=True) for pad in (0, 1)
)


def test_the_order_of_the_taxels_is_that_of_the_mounts() -> None:
    assert (taxel_order(PINCH, ()) == np.arange(156)).all()
    assert (taxel_order(PINCH, EXCHANGED) == np.roll(np.arange(156), 78)).all()
    rows = taxel_order(PINCH, (PadMount(pad=0, sent_as=0, rows_mirrored=True),))
    assert rows[:6].tolist() == [72, 73, 74, 75, 76, 77]
    columns = taxel_order(PINCH, (PadMount(pad=1, sent_as=1, columns_mirrored=True),))
    assert columns[78:84].tolist() == [83, 82, 81, 80, 79, 78]
    assert taxel_order(PINCH, TURNED)[:78].tolist() == list(range(77, -1, -1))


@pytest.mark.parametrize(
    ("mounts", "complaint"),
    [
        ((PadMount(pad=0, sent_as=1),), "name each pad once"),
        ((PadMount(pad=7, sent_as=7),) * 2, "name each pad once"),
        ((PadMount(pad=10, sent_as=10),), "the pads 0 to 9 are"),
        (
            (PadMount(pad=0, sent_as=2), PadMount(pad=2, sent_as=0)),
            "16 x 4 taxels, but is sent as finger0.side_a with 16 x 2: correct sent_as",
        ),
    ],
)
def test_mounts_that_cannot_be_are_refused(mounts, complaint) -> None:
    with pytest.raises(errors.LayoutError, match=complaint):
        taxel_order(paper_layout(), mounts)


def test_forces_and_zero_of_exchanged_and_turned_pads_go_both_ways() -> None:
    message = ForceMessage(
        t_s=1.0, counter=3, status=ScanStatus.ZEROED, force_n=(1.0, 2.0), centre_taxels=(1.5, -0.5)
    )
    exchanged, turned = Mounting(PINCH, EXCHANGED), Mounting(PINCH, TURNED)
    assert exchanged.force(message).force_n == (2.0, 1.0)
    assert exchanged.force(message).centre_taxels == (1.5, -0.5)
    assert turned.force(message).centre_taxels == (-1.5, 0.5)
    zeros = np.arange(156.0)
    bad = zeros == 5
    for mounting in (exchanged, turned):
        place = mounting.zero_order
        sent = encode_zero(9.0, zeros[place], bad[place], PINCH.adc_max)
        touch_counts, values, marked = read_zero(sent, 156, PINCH.adc_max)
        assert touch_counts == pytest.approx(9.0, abs=0.1)
        order = taxel_order(PINCH, EXCHANGED if mounting is exchanged else TURNED)
        assert values[order][~bad] == pytest.approx(zeros[~bad], abs=0.1)
        assert marked[order].tolist() == bad.tolist()


def test_the_unit_cannot_sum_pads_that_are_turned_against_each_other() -> None:
    assert Mounting(PINCH, ()).unit_can_sum
    assert Mounting(PINCH, TURNED).unit_can_sum
    assert not Mounting(PINCH, TURNED[:1]).unit_can_sum
    assert not Mounting(LAYOUT, EXCHANGED).unit_can_sum
    finger_1_first = replace(PINCH, pads=PINCH.pads[::-1])
    assert Mounting(finger_1_first, ()).zero_order.tolist() == list(range(156))


@pytest.mark.parametrize("mounts", [EXCHANGED, TURNED, TURNED[:1]])
def test_a_sensor_measures_where_the_finger_is_on_pads_that_sit_otherwise(mounts) -> None:
    pads, law = (
        PadPair(gains=(0.625, 1.0)),
        FoamCalibration(PINCH.adc_max, np.repeat([1.6, 1.0], 78)),
    )
    settings = SimulatorSettings(layout=PINCH, mounts=mounts, noise_level=0.2, pads=pads)
    with SimulatedCell(settings) as cell:
        link = LinkSettings(mounts=mounts)
        with open_sensor(cell.can_bus, PINCH, law, link=link) as sensor:
            sensor.tare(20)
            cell.devices.world.press(0, 12e-3, -5e-3, 2.0)
            for _ in range(20):
                reading = sensor.read()
            assert reading.finger_force_n == pytest.approx((2.0, 0.0), rel=0.1)
            force_n = reading.force_n[:78]
            x_m, y_m = (force_n @ PINCH.taxel_xy_m[:78] / force_n.sum()).tolist()
            assert (x_m, y_m) == pytest.approx((12e-3, -5e-3), abs=1e-3)
            if Mounting(PINCH, mounts).unit_can_sum:
                assert sensor.take_forces()[-1].force_n == pytest.approx((2.0, 0.0), abs=0.3)
            else:
                assert not sensor.has_forces
