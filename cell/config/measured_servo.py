"""A servo that was measured on the bench: its drive characteristic, from the bench's result."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from cell.data.formats import SERVO_BENCH, read_json
from cell.errors import ConfigError
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import ServoModel

_SCALE_SD, _FRICTION_SD = 0.05, 0.1
"""Uncertainty of a torque by an arm and a kitchen scale, and of a friction, which changes with the
temperature; standard deviations of logarithms. [assumed]"""


def measured_drive(path: Path, model: ServoModel) -> DriveCharacteristic:
    """Return the drive characteristic of a servo from the result of its bench.

    Values of steps that were left out are the catalogue's. Raises ConfigError if there is no such
    file, if it is damaged, or if it is of another model.
    """
    content = read_json(path, SERVO_BENCH, error=ConfigError)
    if content is None:
        raise ConfigError(f"{path}: no such file; `tactile-cell bench servo` writes it")
    if content.get("model") != model.name:
        raise ConfigError(f"{path} is of a {content.get('model')}, this servo is a {model.name}")
    values: Mapping[str, Any] = content.get("values", {})
    drive = DriveCharacteristic.catalogue(model)
    changes: dict[str, float] = {}
    if (rising := values.get("rising_a_nm")) is not None:
        kt_nm_a = 1.0 / rising
        changes |= {"rising_a_nm": rising, "falling_a_nm": rising, "kt_nm_a": kt_nm_a}
        changes |= {"load_sd": _SCALE_SD, "kt_sd": _SCALE_SD}
        changes["inertia_ratio"] = model.kt_nm_a / kt_nm_a
    if (falling := values.get("falling_a_nm")) is not None:
        changes |= {"falling_a_nm": falling, "falling_sd": _SCALE_SD}
    if (coulomb := values.get("coulomb_a")) is not None:
        changes |= {"coulomb_a": coulomb, "viscous_a_s": max(0.0, values["viscous_a_s"])}
        changes |= {"breakaway_a": values.get("breakaway_a", coulomb), "friction_sd": _FRICTION_SD}
    if (back_emf := values.get("back_emf_v_s")) is not None:
        changes["back_emf_v_s"] = back_emf
    return replace(drive, **changes)
