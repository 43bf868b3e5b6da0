"""Data sheets of the simulated servos, apart from the tables of the driver.

Source: ROBOTIS e-Manual, "Specifications" of each model. The driver has figures of its own, so that
an error of one side shows as a difference.
"""

from dataclasses import dataclass
from math import tau

from gripper.dynamixel.models import ServoModel

_RAD_S = tau / 60.0
"""rad/s of one rev/min."""
_FRICTION_SHARE = 0.054
"""Friction over the stall torque where no graph gives it; that of the XM430-W350's graph."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSheet:
    """Figures of one model at its nominal voltage."""

    voltage_v: float
    stall_torque_nm: float
    stall_current_a: float
    no_load_rad_s: float
    inertia_kg_m2: float
    """Inertia of rotor and gears at the output; no vendor gives it, so these are estimates."""
    kt_nm_a: float
    friction_nm: float
    """Torque at the output with rising load: T = kt I - friction."""

    @property
    def winding_ohm(self) -> float:
        """Resistance of the winding, by the current of the stalled motor."""
        return self.voltage_v / self.stall_current_a


def _sheet(
    voltage_v: float, stall_nm: float, stall_a: float, no_load_rad_s: float, inertia_kg_m2: float
) -> DataSheet:
    friction_nm = _FRICTION_SHARE * stall_nm
    return DataSheet(
        voltage_v=voltage_v,
        stall_torque_nm=stall_nm,
        stall_current_a=stall_a,
        no_load_rad_s=no_load_rad_s,
        inertia_kg_m2=inertia_kg_m2,
        kt_nm_a=(stall_nm + friction_nm) / stall_a,
        friction_nm=friction_nm,
    )


_SHEETS = {
    # The performance graph of the XM430-W350 (forum.robotis.com/t/5827); 0.012 kg m² is an upper
    # bound of its inertia.
    "XM430-W350": DataSheet(
        voltage_v=12.0,
        stall_torque_nm=4.1,
        stall_current_a=2.3,
        no_load_rad_s=46 * _RAD_S,
        inertia_kg_m2=0.012,
        kt_nm_a=1.769,
        friction_nm=0.2214,
    ),
    "XM430-W210": _sheet(12.0, 3.0, 2.3, 77 * _RAD_S, 0.0043),
    "XL330-M288": _sheet(5.0, 0.52, 1.47, 103 * _RAD_S, 0.0012),
    "XC330-M288": _sheet(5.0, 0.93, 1.8, 81 * _RAD_S, 0.0012),
    # Peak current, closing speed of 75 mm/s; torque constant and friction are assumed.
    "RH-P12-RN(A)": DataSheet(
        voltage_v=24.0,
        stall_torque_nm=32.0,
        stall_current_a=3.33,
        no_load_rad_s=0.76,
        inertia_kg_m2=0.1,
        kt_nm_a=10.0,
        friction_nm=1.8,
    ),
}


def data_sheet(model: ServoModel) -> DataSheet:
    """Return the data sheet of a model; that of a plug-in's model is its own."""
    return _SHEETS.get(model.name) or _sheet(
        model.nominal_voltage_v,
        model.stall_torque_nm,
        model.stall_current_a,
        model.no_load_rad_s,
        model.rotor_inertia_kg_m2,
    )
