"""The simulated drive, as canopen's own CiA 402 node and single messages see it."""

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402, State402

from motion import object_dictionary as od
from motion.object_dictionary import NEW_SET_POINT, HomingMethod, Status
from simulator.can.drive import DriveMount, SimulatedDrive
from tests.simulator.conftest import DeviceLine

NODE = 11
MOUNT = DriveMount(
    node_id=NODE, increments=1e6, start=2e-3, low_switch=-0.01, high_switch=0.01
)  # 1 increment a µm


@pytest.fixture
def bench() -> DeviceLine:
    """A drive, and canopen's own node of it."""
    network = DeviceLine(SimulatedDrive(MOUNT), step_s=0.001)
    network.wait(0.1)
    network.witness = BaseNode402(NODE, str(od.EDS_PATH))
    network.add_node(network.witness)
    network.witness.nmt.state = "OPERATIONAL"
    network.witness.setup_402_state_machine(read_pdos=False)
    return network


def test_canopens_own_node_leads_it_through_all_states(bench) -> None:
    assert bench.witness.state == "SWITCH ON DISABLED"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        bench.witness.state = state
        assert (bench.witness.state, bench.device.state) == (state, state)
    for state in ("SWITCHED ON", "READY TO SWITCH ON", "SWITCH ON DISABLED"):
        bench.witness.state = state
        assert bench.device.state == state
    bench.witness.state = "OPERATION ENABLED"
    bench.witness.state = "QUICK STOP ACTIVE"
    assert bench.device.state == "QUICK STOP ACTIVE"
    bench.witness.state = "SWITCH ON DISABLED"
    assert bench.device.state == "SWITCH ON DISABLED"


def test_canopens_own_node_changes_modes_and_finds_the_home(bench) -> None:
    for mode in ("PROFILED POSITION", "HOMING"):
        bench.witness.op_mode = mode
        assert bench.witness.op_mode == mode
    assert not bench.witness.is_op_mode_supported("PROFILED VELOCITY")
    bench.witness.sdo["Homing method"].raw = HomingMethod.POSITIVE_SWITCH
    bench.witness.sdo["Home offset"].raw = 7000
    bench.witness.sdo["Homing speeds"][1].raw = 20_000
    bench.witness.sdo["Homing speeds"][2].raw = 2_000
    bench.witness.sdo["Homing acceleration"].raw = 200_000
    assert bench.witness.homing(timeout=30)
    # The switch lets go at 10 mm, where -7000 is read; braking goes on a little.
    assert bench.witness.sdo["Position actual value"].raw + 7000 == pytest.approx(
        1e6 * (bench.device.position - 0.01), abs=15
    )


def test_canopens_own_node_resets_a_fault(bench) -> None:
    bench.witness.state = "OPERATION ENABLED"
    bench.device.fail(0x3210)
    bench.wait(0.05)
    assert (bench.witness.state, bench.witness.sdo["Error code"].raw) == ("FAULT", 0x3210)
    assert [error.code for error in bench.witness.emcy.log] == [0x3210]
    bench.witness.TIMEOUT_RESET_FAULT = 0.0  # canopen waits here in vain, see its FIXME
    bench.witness.reset_from_fault()
    assert (bench.witness.state, bench.witness.emcy.active) == ("OPERATION ENABLED", [])


def enabled(witness: BaseNode402) -> canopen.sdo.SdoClient:
    """Enable the drive in profile position mode; return its objects."""
    witness.op_mode = "PROFILED POSITION"
    sdo = witness.sdo
    sdo["Profile velocity"].raw, sdo["Profile acceleration"].raw = 20_000, 200_000
    sdo["Quick stop deceleration"].raw = 400_000
    witness.state = "OPERATION ENABLED"
    return sdo


def test_a_set_point_is_taken_at_the_rising_edge_and_acknowledged(bench) -> None:
    sdo = enabled(bench.witness)
    sdo["Target position"].raw = 4000
    bench.wait(0.1)
    assert not bench.device.moving  # without the edge nothing moves
    sdo["Controlword"].raw = NEW_SET_POINT
    assert sdo["Statusword"].raw & Status.ACKNOWLEDGED
    assert not sdo["Statusword"].raw & Status.TARGET_REACHED
    sdo["Target position"].raw = -4000
    sdo["Controlword"].raw = NEW_SET_POINT  # no edge: the first target stays
    sdo["Controlword"].raw = State402.CW_OPERATION_ENABLED
    assert not sdo["Statusword"].raw & Status.ACKNOWLEDGED
    bench.wait(1.0)
    assert sdo["Statusword"].raw & Status.TARGET_REACHED
    assert sdo["Position actual value"].raw == pytest.approx(4000, abs=2)


def test_a_target_beyond_the_software_limit_ends_at_the_limit(bench) -> None:
    sdo = enabled(bench.witness)
    sdo["Software position limit"][2].raw = 1500
    sdo["Target position"].raw = 4000
    sdo["Controlword"].raw = NEW_SET_POINT
    bench.wait(1.0)
    assert sdo["Position actual value"].raw == pytest.approx(1500, abs=2)


@pytest.mark.parametrize("switch", [-1, 1])
def test_a_limit_switch_stops_the_axis_and_lets_it_out(bench, switch) -> None:
    sdo = enabled(bench.witness)

    def go(target: int) -> None:
        sdo["Target position"].raw = target
        sdo["Controlword"].raw = NEW_SET_POINT
        sdo["Controlword"].raw = State402.CW_OPERATION_ENABLED
        bench.wait(2.0)

    go(switch * 20_000)
    assert abs(bench.device.position - switch * 0.01) < 1e-3
    assert sdo["Statusword"].raw & Status.INTERNAL_LIMIT
    assert not sdo["Statusword"].raw & Status.TARGET_REACHED
    go(0)
    assert sdo["Statusword"].raw & Status.TARGET_REACHED
    assert bench.device.position == pytest.approx(2e-3, abs=1e-5)


@pytest.mark.parametrize("option", [0, od.STOP_WHEN_HOST_IS_LOST])
def test_a_node_that_is_stopped_on_its_way_brakes_where_6007h_asks_for_it(bench, option) -> None:
    enabled(bench.witness)["Abort connection option code"].raw = option
    bench.witness.nmt.send_command(2)
    assert (bench.device.state == "QUICK STOP ACTIVE") is (option == od.STOP_WHEN_HOST_IS_LOST)
