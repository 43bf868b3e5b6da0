from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from cell.commissioning.servos import read_control_table
from cell.config.file import load_config
from cell.simulation import simulation_of
from gripper.dynamixel import control_table as table
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import MODELS, XM430_W350
from gripper.errors import LimitExceeded, ServoRejected
from gripper.servos.verification import requirements
from gripper.values.servo_checks import hardware_errors_text
from simulator.servo import rh_p12
from simulator.servo.control_table import ServoRegisters


def test_units_and_signs_are_those_of_the_manual() -> None:
    assert pytest.approx(0.0239691, rel=1e-3) == XM430_W350.velocity_unit_rad_s
    assert pytest.approx(0.00153398, rel=1e-5) == XM430_W350.rad_per_pulse
    # The table of the RH-P12-RN(A) below has the addresses of all others.
    assert {table.REGISTERS[name].address for name in MODEL.absent} == {10, 13, 60, 62, 147}
    signed = {r.address for r in table.REGISTERS.values() if r.signed}
    assert signed == {20, 98, 100, 102, 104, 116, 124, 126, 128, 132, 136, 140}


@settings(max_examples=60)
@given(st.sampled_from(sorted(table.REGISTERS)), st.data())
def test_encoding_comes_back(name: str, data: st.DataObject) -> None:
    register = table.REGISTERS[name]
    low, high = register.bounds
    assert high - low == 256**register.size - 1
    assert (low < 0) is register.signed
    raw = data.draw(st.integers(low, high))
    assert register.decode(register.encode(raw)) == raw
    with pytest.raises(LimitExceeded, match=name):
        register.encode(high + 1)


def test_blocks_must_be_contiguous() -> None:
    assert table.RegisterBlock.between(table.REALTIME_TICK, table.PRESENT_TEMPERATURE).size == 27
    for make in (
        lambda: table.RegisterBlock.between(table.TORQUE_ENABLE, table.GOAL_PWM),
        lambda: table.RegisterBlock.between(table.PRESENT_VELOCITY, table.PRESENT_CURRENT),
        lambda: table.RegisterBlock(table.GOAL_CURRENT, table.GOAL_POSITION),
    ):
        with pytest.raises(LimitExceeded, match="contiguous"):
            make()
    with pytest.raises(LimitExceeded, match="goal_velocity = 4294967296 does not fit"):
        table.RegisterBlock(table.GOAL_CURRENT, table.GOAL_VELOCITY).encode((1, 1 << 32))


def test_hardware_error_bits_have_names() -> None:
    assert hardware_errors_text(0x25) == "input voltage, overheating, overload"
    assert hardware_errors_text(0x1A) == "undefined bit 1, encoder, electrical shock"


# -- The RH-P12-RN(A): addresses by the model ------------------------------------------------------


CONFIG = Path(__file__).parents[3] / "config" / "rh-p12-rn.yaml"
MODEL = MODELS["RH-P12-RN(A)"]


def test_driver_and_simulator_agree_on_the_addresses_that_each_has_written_down() -> None:
    rows = {row.name: row for row in rh_p12.ROWS}
    for register in table.REGISTERS.values():
        if register.name in MODEL.absent:
            assert register.name not in rows
            continue
        row = rows[register.name]
        shift = MODEL.ram_shift if register.address >= table.RAM_START else 0
        assert (row.address, row.size) == (register.address + shift, register.size)
        assert (row.access == "RW") == register.writable
    assert not [at for at, r in ServoRegisters(MODEL, {})._items.items() if at >= 512 and r.eeprom]


def test_the_bus_learns_the_table_from_a_ping() -> None:
    with simulation_of(load_config(CONFIG)) as cell:
        bus = ServoBus(cell.servo_port, baudrate=1_000_000, clock=cell.clock)
        with pytest.raises(ServoRejected):
            bus.read(1, table.TORQUE_ENABLE)
        assert bus.ping(1).model_number == 35074
        assert bus.read(1, table.TORQUE_ENABLE) == 0
        present = bus.sync_read([1], table.PRESENT_BLOCK)[1]
        assert present["present_input_voltage"] == 240
        assert 0 < present["present_position"] < 683
        bus._ram_shifts[2] = 0
        with pytest.raises(LimitExceeded, match="separate lines"):
            bus.sync_read([1, 2], table.PRESENT_BLOCK)


def test_what_it_lacks_is_neither_kept_nor_required() -> None:
    with simulation_of(load_config(CONFIG)) as cell:
        bus = ServoBus(cell.servo_port, baudrate=1_000_000, clock=cell.clock)
        backup = read_control_table(bus, 1)
    assert backup["acceleration_limit"] == 3447
    assert [backup[f"external_port_mode_{n}"] for n in (1, 2, 3, 4)] == [3] * 4
    assert set(table.REGISTERS) - set(backup) == MODEL.absent
    required = {row.item for row in requirements(MODEL, 0.5, 70.0)}
    assert "velocity_limit" in required
    assert not required & MODEL.absent
