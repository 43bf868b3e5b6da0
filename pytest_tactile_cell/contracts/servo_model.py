"""Contract of a servo model."""

import pytest

from cell.plugins import SERVO_MODELS
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import ServoModel
from simulator.cell import SimulatedCell
from simulator.settings import SimulatedServoSettings, SimulatorSettings


def test_its_figures_fit_each_other(plugin_name: str) -> None:
    model: ServoModel = SERVO_MODELS[plugin_name]
    assert model.name == plugin_name
    numbers = [other.number for other in SERVO_MODELS.usable().values()]
    assert numbers.count(model.number) == 1
    assert model.min_voltage_raw < model.nominal_voltage_v / model.voltage_unit_v
    assert model.nominal_voltage_v / model.voltage_unit_v <= model.max_voltage_raw
    stall_nm = model.kt_nm_a * model.stall_current_a - model.friction_nm
    # Data sheets differ from measured motors by a third.
    assert stall_nm == pytest.approx(model.stall_torque_nm, rel=0.5)
    assert 0.0 < model.friction_nm < 0.5 * model.stall_torque_nm
    assert model.rotor_inertia_kg_m2 > 0.0
    count_a = 2.0 * model.current_unit_a
    assert model.winding_a(round(model.current_counts(0.5))) == pytest.approx(0.5, abs=count_a)


def test_its_simulated_servo_answers(plugin_name: str) -> None:
    model: ServoModel = SERVO_MODELS[plugin_name]
    servos = tuple(SimulatedServoSettings(servo_id=n, model=model) for n in (1, 2))
    settings = SimulatorSettings(servos=servos)
    with SimulatedCell(settings) as cell:
        bus = ServoBus(cell.servo_port, baudrate=settings.servo_baud_rate, clock=cell.clock)
        assert bus.ping(1).model_number == model.number
