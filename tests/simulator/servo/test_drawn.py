"""Servos that are drawn at random: within the spread of real ones, and the same for a seed."""

import pytest

from gripper.dynamixel.models import MODELS, XM430_W350
from simulator.servo.data_sheets import data_sheet
from simulator.servo.drawn import drawn_gearing
from simulator.servo.gearing import IDEAL_GEARING
from simulator.settings import SimulatedServoSettings


def test_the_servos_of_a_cell_are_drawn_by_its_seed_and_their_ids():
    first, second = (SimulatedServoSettings(servo_id=n, gearing=None) for n in (1, 2))
    figures = [one.motor(seed).kt_nm_a for one in (first, second) for seed in (0, 1)]
    assert len(set(figures)) == 4
    again = [one.motor(seed).kt_nm_a for one in (first, second) for seed in (0, 1)]
    assert again == figures
    ideal = SimulatedServoSettings(servo_id=1, gearing=IDEAL_GEARING)
    assert ideal.motor(0).kt_nm_a == ideal.motor(1).kt_nm_a == data_sheet(XM430_W350).kt_nm_a


def test_drawn_xm430_w350_are_within_the_spread_of_real_ones():
    drives = [drawn_gearing(XM430_W350, str(seed)).identified for seed in range(200)]
    friction_ma = [1e3 * one.friction.base_nm[0] / one.kt_nm_a for one in drives]
    for found, low, high in (
        (friction_ma, 18.0, 82.0),
        ([one.kt_nm_a for one in drives], 1.65, 1.95),
        ([one.breakaway for one in drives], 1.3, 1.8),
        ([one.inertia_kg_m2 for one in drives], 0.003, 0.006),
    ):
        assert low <= min(found) < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < max(found) <= high


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_a_drawn_servo_is_near_its_data_sheet(model):
    typical = drawn_gearing(model, None).identified
    volt = typical.winding_ohm * model.stall_current_a
    assert volt == pytest.approx(model.nominal_voltage_v, rel=0.01)
    # Less than the whole supply turns it as fast as without load.
    assert 0.9 < typical.back_emf_v_s * model.no_load_rad_s / volt < 1.0
    stall_nm = typical.friction.forward_nm(typical.kt_nm_a * model.stall_current_a, 0.0)
    # The vendor's stall torque of an XL330 is 1.4 to 1.8 times that of its logs.
    assert 0.5 < stall_nm / model.stall_torque_nm < 1.05
