"""Control table of the RH-P12-RN(A) as data, for its simulation.

Source: ROBOTIS e-Manual, RH-P12-RN(A), "Control Table of EEPROM Area" and "of RAM Area". It shares
no figure with the driver. Data of external ports and indirect addresses are left out: nothing here
uses them.
"""

from typing import NamedTuple


class Row(NamedTuple):
    """One line of the e-Manual."""

    address: int
    size: int
    name: str
    access: str
    initial: int = 0
    """Factory value; what the manual leaves open is assumed."""
    low: int | None = None
    high: int | None = None
    """Range; None where every value fits."""


# fmt: off
ROWS = (
    Row(0, 2, "model_number", "R", 35074),
    Row(2, 4, "model_information", "R"),
    Row(6, 1, "firmware_version", "R", 12),
    Row(7, 1, "id", "RW", 1, 0, 252),
    Row(8, 1, "baud_rate", "RW", 1, 0, 9),
    Row(9, 1, "return_delay_time", "RW", 250, 0, 255),
    Row(11, 1, "operating_mode", "RW", 5, 0, 5),
    Row(12, 1, "secondary_id", "RW", 255, 0, 255),
    Row(20, 4, "homing_offset", "RW", 0, 0, 1150),
    Row(24, 4, "moving_threshold", "RW", 80, 0, 2970),
    Row(31, 1, "temperature_limit", "RW", 80, 0, 100),
    Row(32, 2, "max_voltage_limit", "RW", 350, 150, 300),
    Row(34, 2, "min_voltage_limit", "RW", 150, 150, 300),
    Row(36, 2, "pwm_limit", "RW", 2009, 0, 2009),
    Row(38, 2, "current_limit", "RW", 1984, 0, 1984),
    Row(40, 4, "acceleration_limit", "RW", 3447, 0, 1_378_788),
    Row(44, 4, "velocity_limit", "RW", 2970, 0, 2970),
    Row(48, 4, "max_position_limit", "RW", 1150, 0, 1150),
    Row(52, 4, "min_position_limit", "RW", 0, 0, 1150),
    Row(56, 1, "external_port_mode_1", "RW", 3, 0, 3),
    Row(57, 1, "external_port_mode_2", "RW", 3, 0, 3),
    Row(58, 1, "external_port_mode_3", "RW", 3, 0, 3),
    Row(59, 1, "external_port_mode_4", "RW", 3, 0, 3),
    Row(63, 1, "shutdown", "RW", 52, 0, 255),
    Row(512, 1, "torque_enable", "RW", 0, 0, 1),
    Row(513, 1, "led", "RW", 0, 0, 255),
    Row(514, 1, "led_green", "RW", 0, 0, 255),
    Row(515, 1, "led_blue", "RW", 0, 0, 255),
    Row(516, 1, "status_return_level", "RW", 2, 0, 2),
    Row(517, 1, "registered_instruction", "R"),
    Row(518, 1, "hardware_error_status", "R"),
    Row(524, 2, "velocity_i_gain", "RW", 0, 0, 32767),
    Row(526, 2, "velocity_p_gain", "RW", 0, 0, 32767),
    Row(528, 2, "position_d_gain", "RW", 0, 0, 32767),
    Row(530, 2, "position_i_gain", "RW", 0, 0, 32767),
    Row(532, 2, "position_p_gain", "RW", 640, 0, 32767),
    Row(536, 2, "feedforward_2nd_gain", "RW", 0, 0, 32767),
    Row(538, 2, "feedforward_1st_gain", "RW", 0, 0, 32767),
    Row(546, 1, "bus_watchdog", "RW", 0, 0, 127),
    Row(548, 2, "goal_pwm", "RW"),
    Row(550, 2, "goal_current", "RW"),
    Row(552, 4, "goal_velocity", "RW"),
    Row(556, 4, "profile_acceleration", "RW", 0, 0, 3447),
    Row(560, 4, "profile_velocity", "RW", 0, 0, 2970),
    Row(564, 4, "goal_position", "RW"),
    Row(568, 2, "realtime_tick", "R"),
    Row(570, 1, "moving", "R"),
    Row(571, 1, "moving_status", "R"),
    Row(572, 2, "present_pwm", "R"),
    Row(574, 2, "present_current", "R"),
    Row(576, 4, "present_velocity", "R"),
    Row(580, 4, "present_position", "R"),
    Row(584, 4, "velocity_trajectory", "R"),
    Row(588, 4, "position_trajectory", "R"),
    Row(592, 2, "present_input_voltage", "R"),
    Row(594, 1, "present_temperature", "R"),
)
# fmt: on
NUMBER = 35074
"""Model Number."""
MODES = frozenset({0, 5})
"""Operating modes: current, and current-based position."""
EEPROM_END = 512
"""First address after the EEPROM."""
SIGNED = frozenset(
    {"homing_offset", "bus_watchdog", "goal_pwm", "goal_current", "goal_velocity", "goal_position"}
    | {"present_pwm", "present_current", "present_velocity", "present_position"}
    | {"velocity_trajectory", "position_trajectory"}
)
"""Items in two's complement: those that the manual lets be negative, and the watchdog that tripped.
"""
TABLE_SIZE = 762
"""Bytes that can be addressed."""
OTHER_PLACES = {"led_green": 66, "led_blue": 67}
"""Bytes of the items that the X series does not have, in the memory of its simulation."""
