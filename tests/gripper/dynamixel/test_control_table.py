from math import exp

import pytest
from hypothesis import given, settings, strategies as st

from gripper.dynamixel.control_table import (
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_PWM,
    GOAL_VELOCITY,
    PRESENT_CURRENT,
    PRESENT_POSITION,
    PRESENT_TEMPERATURE,
    PRESENT_VELOCITY,
    REALTIME_TICK,
    REGISTERS,
    TORQUE_ENABLE,
    RegisterBlock,
)
from gripper.dynamixel.models import MODELS, XM430_W350, require_current_control
from gripper.errors import LimitExceeded
from gripper.values.servo_checks import hardware_error_names


def test_units_and_signs_are_those_of_the_manual() -> None:
    assert pytest.approx(0.0239691, rel=1e-3) == XM430_W350.velocity_unit_rad_s
    assert pytest.approx(0.00153398, rel=1e-5) == XM430_W350.rad_per_pulse
    signed = {r.address for r in REGISTERS.values() if r.signed}
    assert signed == {20, 98, 100, 102, 104, 116, 124, 126, 128, 132, 136, 140}


@settings(max_examples=60)
@given(st.sampled_from(sorted(REGISTERS)), st.data())
def test_encoding_comes_back(name: str, data: st.DataObject) -> None:
    register = REGISTERS[name]
    low, high = register.bounds
    assert high - low == 256**register.size - 1
    assert (low < 0) is register.signed
    raw = data.draw(st.integers(low, high))
    assert register.decode(register.encode(raw)) == raw
    with pytest.raises(LimitExceeded, match=name):
        register.encode(high + 1)


def test_blocks_must_be_contiguous() -> None:
    block = RegisterBlock.between(PRESENT_CURRENT, PRESENT_POSITION)
    with pytest.raises(LimitExceeded, match="present_position have 10 bytes, got 9"):
        block.decode(bytes(9))
    assert RegisterBlock.between(REALTIME_TICK, PRESENT_TEMPERATURE).size == 27
    for make in (
        lambda: RegisterBlock.between(TORQUE_ENABLE, GOAL_PWM),
        lambda: RegisterBlock.between(PRESENT_VELOCITY, PRESENT_CURRENT),
        lambda: RegisterBlock(GOAL_CURRENT, GOAL_POSITION),
    ):
        with pytest.raises(LimitExceeded, match="contiguous"):
            make()
    with pytest.raises(LimitExceeded, match="goal_velocity = 4294967296 does not fit"):
        RegisterBlock(GOAL_CURRENT, GOAL_VELOCITY).encode((1, 1 << 32))


def test_models_carry_the_data_sheet() -> None:
    assert {m.number for m in MODELS.values()} == {1020, 1030, 1200, 1240, 35074}
    assert XM430_W350.current_raw(0.46) == 171
    assert XM430_W350.winding_a(500) == pytest.approx(1.345)
    assert MODELS["XL330-M288"].factory_defaults["shutdown"] == 53
    for model in MODELS.values():
        stall_nm = model.kt_nm_a * model.stall_current_a - model.friction_nm
        # The torque of a slow rise is measured on the 330 size; the uncertainty covers both.
        spread = exp(2.0 * model.kt_sd) if model.supply_current else 1.07
        assert stall_nm < model.stall_torque_nm * 1.07 < 1.07 * spread * stall_nm


def test_models_without_current_control_are_refused_with_the_reason() -> None:
    with pytest.raises(LimitExceeded, match="no Goal Current"):
        require_current_control("XL430-W250")
    with pytest.raises(LimitExceeded, match="not known"):
        require_current_control("AX-12")


def test_hardware_error_bits_have_names() -> None:
    assert hardware_error_names(0x25) == ("input voltage", "overheating", "overload")
    assert hardware_error_names(0x02) == ("undefined bit 1",)
