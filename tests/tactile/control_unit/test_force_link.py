"""The link to a unit that sends force messages: set-up, order on the bus, what goes wrong."""

from collections.abc import Callable
from functools import partial

import can
import numpy as np
import pytest

from simulator.can.control_unit import ControlUnitSettings
from tactile.control_unit import object_dictionary as od
from tactile.errors import FrameTimeout, IdentityMismatch, LinkFault
from tactile.layout import paper_layout
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.opening import force_table
from tactile.source import ForceStatus, PadZero
from tests.tactile.conftest import Bench

LAYOUT = paper_layout()
TABLE = force_table(LAYOUT, FoamCalibration(255))
ZERO = PadZero(
    offset_counts=np.zeros(128), noise_counts=np.full(128, 5.6), bad=np.zeros(128, dtype=np.bool_)
)


@pytest.fixture
def make_forces(make_bench: Callable[..., Bench]) -> Callable[..., Bench]:
    """Return what makes a bench whose unit sends its force each 3 ms."""
    return partial(make_bench, table=TABLE, force_period_s=0.003)


@pytest.fixture
def bench(make_forces: Callable[..., Bench]) -> Bench:
    made = make_forces()
    made.link.start()
    made.link.set_zero(ZERO)
    return made


def test_the_force_comes_by_table_and_zero_each_three_milliseconds(bench) -> None:
    assert bench.link.sends_forces
    bench.skin.counts[:] = 20
    bench.forces(0.1)
    found = bench.forces(0.3)
    assert len(found) == pytest.approx(100, abs=1)
    taxel_n = float(FoamCalibration(255).force_n(np.array([20.0]))[0])
    assert found[-1].force_n == pytest.approx((64 * taxel_n, 64 * taxel_n), rel=0.01)
    assert found[-1].status == ForceStatus.ZEROED
    assert np.diff([message.t_s for message in found]).max() < 0.0035
    assert bench.link.statistics.forces.lost == 0


def test_a_force_message_waits_for_one_message_of_a_burst_and_no_more(make_forces) -> None:
    def worst_wait_s(frame_function: int) -> float:
        bench = make_forces()
        bench.link.start()
        if frame_function != od.COB_TPDO3:
            # As if the frames had stayed before the forces: TPDO1 and TPDO2 as in the EDS.
            bench.unit.dictionary.pretend(od.TPDO1_PARAMETER, 1, frame_function + 5)
            bench.unit.command("OPERATIONAL", bench.clock.monotonic())
        bench.traffic.clear()
        for _ in range(300):
            bench.clock.sleep(0.001)
            if frame_function == od.COB_TPDO3:
                bench.link.poll()
            elif bench.clock.monotonic() % 0.02 < 0.001:
                bench.bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        ends_s = [t_s for t_s, can_id, _ in bench.traffic if can_id == 0x285]
        spacing_s = np.diff(ends_s)
        return float(np.abs(spacing_s - 0.003).max())

    assert worst_wait_s(od.COB_TPDO3) < 0.00026
    assert worst_wait_s(od.COB_TPDO1) > 0.002


def test_a_unit_without_force_messages_runs_as_before(make_forces) -> None:
    bench = make_forces(unit=ControlUnitSettings(force_messages=False))
    bench.link.start()
    assert not bench.link.sends_forces
    assert bench.forces(0.2) == []
    assert bench.link.statistics.frames.complete >= 9
    assert {can_id for _, can_id, _ in bench.traffic} >= {0x185}


def test_a_table_that_the_unit_does_not_keep_is_refused(make_forces) -> None:
    bench = make_forces()
    bench.unit.dictionary.pretend(od.FORCE_TABLE, 0, TABLE[:-2] + b"\0\0")
    with pytest.raises(IdentityMismatch, match="table of counts to force"):
        bench.link.start()


@pytest.mark.parametrize(("knob", "silence_s"), [("forces_off", 0.2), ("dead", 0.2)])
def test_a_longer_silence_is_allowed_where_that_is_set(make_forces, knob, silence_s) -> None:
    bench = make_forces(silence_s=silence_s, heartbeat_s=1.0)
    bench.link.start()
    bench.link.set_zero(ZERO)
    bench.forces(0.1)
    setattr(bench.unit.faults, knob, True)
    bench.forces(silence_s - 0.04)
    with pytest.raises(FrameTimeout, match=r"no (force message|whole frame)"):
        bench.forces(0.08)


def stall(bench: Bench, monkeypatch: pytest.MonkeyPatch, stall_s: float = 0.057) -> None:
    """Stand still, and then find nothing: the thread that receives stood still, too."""
    source = bench.link._source
    with monkeypatch.context() as asleep:
        asleep.setattr(source, "drain", lambda: [])
        bench.clock.sleep(stall_s)
        bench.link.poll()


def test_a_stall_of_the_host_is_no_silence_of_the_unit(make_forces, monkeypatch) -> None:
    bench = make_forces(heartbeat_s=0.02)
    bench.link.start()
    bench.link.set_zero(ZERO)
    for _ in range(5):
        bench.forces(0.1)
        stall(bench, monkeypatch)
        assert bench.forces(0.02)


@pytest.mark.parametrize("stall_s", [0.057, 0.115, 0.16])
def test_what_came_in_a_stall_of_the_host_is_not_late(bench, monkeypatch, stall_s) -> None:
    source = bench.link._source
    drain = source.drain
    # The thread that receives stamps what it reads at the end of the stall.
    monkeypatch.setattr(source, "drain", lambda: [(bench.clock.monotonic(), m) for _, m in drain()])
    for _ in range(3):
        bench.forces(0.3)
        bench.clock.sleep(stall_s)
        bench.link.poll()
    assert bench.forces(0.3)


@pytest.mark.parametrize(("knob", "limit_s"), [("forces_off", 0.04), ("heartbeat_off", 0.25)])
def test_a_silent_unit_is_found_within_its_limit_and_the_stall(
    bench, monkeypatch, knob, limit_s
) -> None:
    bench.forces(0.1)
    start_s = bench.clock.monotonic()
    setattr(bench.unit.faults, knob, True)
    bench.forces(0.01)
    stall(bench, monkeypatch)
    with pytest.raises(LinkFault, match=r"no (force message|heartbeat) from"):
        bench.forces(1.0)
    assert bench.clock.monotonic() - start_s < limit_s + 0.057 + 0.002
