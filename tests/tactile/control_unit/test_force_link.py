"""Force messages on the link, and pads that sit otherwise: set-up, order, what goes wrong."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from simulator.can.control_unit import ControlUnitSettings
from simulator.can.scanner import read_zero
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.node import Mounting
from tactile.control_unit.settings import LinkSettings
from tactile.errors import BusDisturbed, FrameTimeout, IdentityMismatch, LayoutError, LinkFault
from tactile.frames import encode_zero, force_table
from tactile.layout import PadMount, paper_layout, pinch_layout, taxel_order
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.opening import open_sensor
from tactile.source import ForceMessage, ForceStatus, PadZero
from tests.tactile.conftest import Bench

LAYOUT = paper_layout()
TABLE = force_table(LAYOUT, FoamCalibration(255).force_n)
ZERO = PadZero(offset_counts=np.zeros(128), touch_counts=4.0, bad=np.zeros(128, dtype=np.bool_))


@pytest.fixture
def make_forces(make_bench: Callable[..., Bench]) -> Callable[..., Bench]:
    """Return what makes a bench whose unit sends its force each 3 ms."""
    return partial(make_bench, table=TABLE, force_period_s=0.003)


def started(bench: Bench) -> Bench:
    bench.link.start()
    bench.link.set_zero(ZERO)
    return bench


@pytest.fixture
def sending(make_forces: Callable[..., Bench]) -> Bench:
    return started(make_forces())


def test_the_force_comes_by_table_and_zero_each_three_milliseconds(sending) -> None:
    assert sending.link.sends_forces
    sending.skin.counts[:] = 20
    sending.forces(0.1)
    messages = sending.forces(0.3)
    assert len(messages) == pytest.approx(100, abs=1)
    taxel_n = float(FoamCalibration(255).force_n(np.array([20.0]))[0])
    assert messages[-1].force_n == pytest.approx((64 * taxel_n, 64 * taxel_n), rel=0.01)
    assert messages[-1].status == ForceStatus.ZEROED
    assert np.diff([message.t_s for message in messages]).max() < 0.0035
    assert sending.link.statistics.forces.lost == 0


def test_messages_that_a_gateway_delays_are_refused_before_the_set_up(make_forces) -> None:
    bench = make_forces()
    bench.bus.faults.delay_s = 0.03
    with pytest.raises(FrameTimeout, match=r"answers after 31 ms, allowed .* are 15 ms"):
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
    sending.link.start()
    assert not sending.link.sends_forces
    assert sending.forces(0.2) == []
    assert sending.link.statistics.frames.complete >= 9
    assert {can_id for _, can_id, _ in sending.traffic} >= {0x185}


def test_a_table_that_the_unit_does_not_keep_is_refused(make_forces) -> None:
    sending = make_forces()
    sending.unit.pretend(od.FORCE_TABLE, TABLE[:-2] + b"\0\0")
    with pytest.raises(IdentityMismatch, match="Table of counts to force"):
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
    with pytest.raises(FrameTimeout, match=r"no (force message|whole frame)"):
        sending.forces(0.08)


def test_too_many_old_force_messages_are_a_fault(sending) -> None:
    """Each second one comes before the one that was made earlier."""
    held: list[bytes] = []

    def later(burst: list[bytes]) -> list[bytes]:
        held.extend(burst)
        return [held.pop(), held.pop()] if len(held) == 2 else []

    sending.forces(0.1)
    sending.alter(0x285, later)
    with pytest.raises(BusDisturbed, match="force messages that are older than the one before"):
        sending.forces(1.0)


def stall(sending: Bench, monkeypatch: pytest.MonkeyPatch, stall_s: float = 0.057) -> None:
    """Stand still, and then find nothing: the thread that receives stood still, too."""
    source = sending.link._source
    with monkeypatch.context() as asleep:
        asleep.setattr(source, "drain", lambda: [])
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
    with pytest.raises(LinkFault, match=r"no (force message|heartbeat) from"):
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
        (
            (PadMount(pad=0, sent_as=2), PadMount(pad=2, sent_as=0)),
            "16 x 4 taxels, but is sent as finger0.side_a with 16 x 2: correct sent_as",
        ),
    ],
)
def test_mounts_that_cannot_be_are_refused(mounts, complaint) -> None:
    with pytest.raises(LayoutError, match=complaint):
        taxel_order(paper_layout(), mounts)


def test_forces_and_zero_of_exchanged_and_turned_pads_go_both_ways() -> None:
    message = ForceMessage(
        t_s=1.0, counter=3, status=ForceStatus.ZEROED, force_n=(1.0, 2.0), centre_taxels=(1.5, -0.5)
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


@pytest.mark.parametrize("mounts", [EXCHANGED, TURNED, TURNED[:1]])
def test_a_sensor_measures_where_the_finger_is_on_pads_that_sit_otherwise(mounts) -> None:
    settings = SimulatorSettings(layout=PINCH, mounts=mounts, noise_level=0.2)
    with SimulatedCell(settings) as cell:
        link = LinkSettings(mounts=mounts)
        with open_sensor(cell.can_bus, PINCH, link=link) as sensor:
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
