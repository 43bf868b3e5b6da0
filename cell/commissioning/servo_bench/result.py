"""The result of the bench: a log, a file with the values, and their comparison with the model."""

import csv
import io
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from cell.commissioning.engine import Dialog, StepFailed
from cell.commissioning.servo_bench.protocol import STEPS, Values
from cell.commissioning.servo_bench.rig import Reading, Rig
from cell.errors import CellError
from cell.files import free_name, write_text
from cell.formats import SERVO_BENCH, write_json
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import ServoModel
from gripper.errors import GripperError


def findings(model: ServoModel, values: Values) -> list[str]:
    """Return the lines of the result: each number with the model's, and what else was found."""
    drive = DriveCharacteristic.catalogue(model)
    use = "use `measured` in the config"
    ratio = f"{use}, or the force is off by this ratio"
    # Name, value of the model, share by which it may differ, and what a larger difference means.
    rows = (
        ("error_per_pwm", model.error_per_pwm, 0.03, "the goal's lead of this model is wrong"),
        ("winding_ohm", model.winding_ohm, 0.2, "the winding was warm, or the model is wrong"),
        ("rising_a_nm", drive.rising_a_nm, 0.15, ratio),
        ("falling_a_nm", drive.falling_a_nm, 0.3, ratio),
        ("back_emf_v_s", model.back_emf_v_s, 0.15, "checks of the encoder by the motor are off"),
        ("coulomb_a", drive.coulomb_a, 0.5, use),
        ("breakaway_a", drive.breakaway_a, 0.5, use),
    )
    lines = []
    for name, of_model, within, consequence in rows:
        if (measured := values.get(name)) is not None:
            agrees = abs(measured - of_model) <= within * of_model
            verdict = "agrees" if agrees else f"differs: {consequence}"
            lines.append(f"{name}: model {of_model:.4g}, measured {measured:.4g}, {verdict}")
    if (gains := values.get("gains_mode_5")) is not None:
        lines.append(f"gains that mode 5 sets by itself (D, I, P): {gains}")
    if (window_s := values.get("velocity_mean_s")) is not None:
        delay_s = 0.5 * window_s + values["velocity_low_pass_s"]
        lines.append(
            f"Present Velocity is {1e3 * delay_s:.0f} ms late; positions measure the motion"
        )
    if (exponent := values.get("duty_exponent")) is not None:
        by_supply = exponent < 0.75
        whose = "supply" if by_supply else "winding"
        line = f"the current registers are those of the {whose} (PWM ~ current^{exponent:.2f})"
        if by_supply != model.supply_current:
            line += ", unlike its model: do not use this servo, and report its firmware"
        lines.append(line)
    for name, held in values.get("held", {}).items():
        end = "held" if (s := held["trip_s"]) is None else f"tripped after {s:.0f} s: a part drops"
        lines.append(f"{name} A on the scale: {end}")
    if (share := values.get("held_share")) is not None:
        lines.append(
            f"after the watchdog tripped it holds {100.0 * share:.0f} % of the force"
            + ("" if share > 0.5 else ": a part drops when the host dies")
        )
    return lines


def run_bench(rig: Rig, dialog: Dialog, folder: Path) -> tuple[Path, ...]:
    """Run the steps that the person wants, and write log and result; return their paths.

    A step that fails, or an abort, keeps what was measured before. Raises CellError if the files
    cannot be written.
    """
    values: Values = {}
    done: list[str] = []
    try:
        for number, step in enumerate(STEPS, start=1):
            answer = dialog.choose(
                f"{step.key}.begin",
                f"{number}/{len(STEPS)} {step.title} (about {step.minutes} min)\n{step.text}",
                {"run": "ready: run the step", "leave": "leave the step out"},
                "run",
            )
            if answer == "leave":
                continue
            try:
                with rig.running(step.key):
                    results = step.run(rig, dialog)
                values |= {name: value for name, value in results.items() if value is not None}
                done.append(step.key)
            except (StepFailed, GripperError) as why:
                dialog.say(f"{step.title} failed: {why}")
    finally:
        for line in findings(rig.model, values):
            dialog.say(line)
        files = _write(rig, values, done, folder)
    return files


def _write(rig: Rig, values: Values, done: Sequence[str], folder: Path) -> tuple[Path, ...]:
    folder.mkdir(parents=True, exist_ok=True)
    name = f"servo-bench-{rig.model.name.lower()}-id{rig.servo_id}"
    log = free_name(folder / f"{name}.csv")
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(Reading._fields)
    writer.writerows(rig.log)
    write_text(log, text.getvalue(), error=CellError, what="log of the bench")
    result = log.with_suffix(".json")
    content = {
        "model": rig.model.name,
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "steps": done,
        "values": values,
    }
    write_json(result, SERVO_BENCH, content, error=CellError)
    return log, result
