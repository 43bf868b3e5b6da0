"""`hand zero`, `hand release`, `hand clear`: gripper and sensor without a job."""

from pathlib import Path
from typing import Annotated, Any

import typer

from cell.errors import CellError, ConfigError
from cell.interfaces.cli import options
from cell.interfaces.cli.session import (
    cell_config,
    cell_of_earlier_run,
    clear_command,
    release_command,
    running_cell,
)
from cell.interfaces.cli.terminal import print_line, print_note
from cell.runtime.goals import ZeroGoal
from gripper.errors import ServoFault
from motion.errors import MotionError

NamedConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="Config file of the cell; required.")
]


def zero(
    config: options.Config = None, out_folder: options.Out = None, json_file: options.Json = None
) -> None:
    """Close the empty fingers on each other: zero of the opening, gains of the pads, foam.

    Later commands of this cell use the result. First remove everything between the fingers.
    """
    checked = cell_config(config)
    if checked.self_zero in ("always", "daily"):
        # Measured once: by this command, not at the start too.
        checked = checked.model_copy(update={"self_zero": "on_demand"})
    values: dict[str, Any] = {}
    with running_cell(checked, "zero", out_folder, config_file=config, json_file=json_file) as cell:
        cell.run(ZeroGoal(), lambda job: values.update(job.progress))
        if zero_note := cell.plugin.health()["zero"]["text"]:
            print_note(zero_note)
    lines = [values["text"]]
    if (moved_mm := values["zero"]["moved_mm"]) is not None:
        lines.append(f"{moved_mm:+.2f} mm since the last measurement")
    cell.finish(lines, values["zero"])


def release(
    config: NamedConfigOption = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Confirm that the part may fall; required.")
    ] = False,
) -> None:
    """Release a part that an earlier run left in the grip; it may fall.

    Only the servos are needed, not the control unit. If the servo of a finger is silent or off, a
    message names that finger and the other finger opens. Always name the config file, even if the
    folder has one. It selects the cell whose part falls.
    """
    if config is None or not confirm:
        example = options.or_of_folder(config) or Path("FILE")
        raise ConfigError(
            "the part may fall: name the config file of the cell and confirm; nothing was moved. "
            f"The whole command: `{release_command(example)}`"
        )
    checked = cell_config(config)
    with cell_of_earlier_run(checked) as cell:
        report = cell.controller.release_held()
    print_line(
        f"{checked.name}: released; {report}"
        + ("; the cell is simulated, no real part was moved" if checked.simulated else "")
    )


def clear(
    config: NamedConfigOption = None,
    reboot: Annotated[
        bool, typer.Option("--reboot", help="Restart servos with an error; their part may fall.")
    ] = False,
) -> None:
    """Show torque and errors of servos and axes, and clear them; nothing moves.

    After overload, heat or a shock a servo switches its torque off until it is rebooted. A part
    that other servos hold stays held. Drives of axes need no reboot. The control unit is not
    needed.
    """
    if config is None:
        raise ConfigError(
            "name the config file of the cell. The whole command: `tactile-cell hand clear "
            f"--config {options.or_of_folder(config) or 'FILE'}`"
        )
    checked = cell_config(config)
    try:
        with cell_of_earlier_run(checked) as cell:
            before = cell.controller.hand.conditions()
            for condition in before:
                print_line(f"{checked.name}: {condition}")
            cell.controller.life.clear(reboot=reboot)
            after = cell.controller.hand.conditions()
            if cell.axes is not None:
                try:
                    cell.axes.clear_faults(reboot=reboot)
                finally:
                    for name, state in cell.axes.inspect().items():
                        print_line(f"{checked.name}: {name} is in {state}")
    except ServoFault as error:
        raise CellError(f"{error}: {clear_command(config)}") from error
    except MotionError as error:
        raise CellError(str(error)) from error
    for condition in after:
        if condition not in before:
            print_line(f"{checked.name}: after the reboot {condition}")
    if any(condition.torque_on for condition in after):
        print_line(f"a part may be in the grip; to release it: `{release_command(config)}`")
    bad = [str(condition) for condition in after if condition.error_bits or not condition.answers]
    if bad:
        raise CellError(f"{'; '.join(bad)}: remove the cause, then clear again")
