"""The RH-P12-RN(A) on its bus: addresses by the model, and its own limits of goals."""

from pathlib import Path

import pytest

from cell.commissioning.backup import read_control_table
from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.simulation import simulation_of
from gripper.dynamixel import control_table as table
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import MODELS, XM430_W350, OperatingMode
from gripper.dynamixel.protocol2 import Instruction
from gripper.errors import LimitExceeded, ServoRejected
from gripper.servos.verification import requirements
from simulator.servo import rh_p12
from simulator.servo.control_table import ControlTable
from simulator.servo.device import SimulatedServo
from simulator.servo.motor import ServoMotor

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


def test_its_backup_has_the_items_that_the_x_series_lacks() -> None:
    with simulation_of(load_config(CONFIG)) as cell:
        bus = ServoBus(cell.servo_port, baudrate=1_000_000, clock=cell.clock)
        kept = read_control_table(bus, 1)
    assert kept["acceleration_limit"] == 3447
    assert [kept[f"external_port_mode_{n}"] for n in (1, 2, 3, 4)] == [3] * 4
    assert set(table.REGISTERS) - set(kept) == MODEL.absent
    with simulation_of(CellConfig()) as cell:
        bus = ServoBus(cell.servo_port, baudrate=1_000_000, clock=cell.clock)
        assert set(table.REGISTERS) - set(read_control_table(bus, 1)) == XM430_W350.absent


def test_goals_keep_to_the_range_and_a_goal_velocity_of_none_stops() -> None:
    one = SimulatedServo(1, MODEL, ServoMotor(MODEL, angle_rad=0.5))
    assert one.core.registers.get("operating_mode") == OperatingMode.CURRENT_BASED_POSITION
    goal = (564).to_bytes(2, "little")
    for raw, error in ((1151, 6), (-1, 6), (1150, 0)):
        parameters = goal + raw.to_bytes(4, "little", signed=True)
        assert one.execute(Instruction.WRITE, parameters, 0.0).error == error
    one.core.set_torque(on=True)
    assert one.core.plant.command.duty == 0.0
    one.execute(Instruction.WRITE, (552).to_bytes(2, "little") + (2970).to_bytes(4, "little"), 0.0)
    assert one.core.plant.command.duty == 1.0


def test_what_it_lacks_is_not_required() -> None:
    items = {r.item for r in requirements(MODEL, 0.5, 70.0)}
    assert not items & MODEL.absent
    assert "velocity_limit" in items
    assert not MODEL.turns
