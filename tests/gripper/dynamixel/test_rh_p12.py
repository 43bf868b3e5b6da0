"""The RH-P12-RN(A) on its bus: addresses by the model, and its own limits of goals."""

from pathlib import Path

import pytest

from cell.commissioning.backup import read_control_table
from cell.config.file import load_config
from cell.simulation import simulation_of
from gripper.dynamixel import control_table as table
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import MODELS
from gripper.errors import LimitExceeded, ServoRejected
from gripper.servos.verification import requirements
from simulator.servo import rh_p12
from simulator.servo.control_table import ControlTable

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
    assert not [r for r in ControlTable(MODEL).items if r.wire >= 512 and r.eeprom]


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
