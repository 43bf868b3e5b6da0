"""`clear`: acknowledges errors of servos and axes from an earlier run."""

from typing import Annotated

import typer

from cell.interfaces.cli.commands.release import NamedConfigOption


def clear(
    config: NamedConfigOption = None,
    reboot: Annotated[
        bool,
        typer.Option(
            "--reboot",
            help="Restart servos that report an error; a part that they hold may fall.",
        ),
    ] = False,
) -> None:
    """Show torque and errors of servos and axes, and clear them; nothing moves.

    After overload, heat or a shock a servo switches its torque off until it is rebooted. A part
    that other servos hold stays held. Drives of axes need no reboot. The control unit is not
    needed.
    """
    from cell.errors import CellError, ConfigError
    from cell.interfaces.cli.session import (
        cell_config,
        cell_of_earlier_run,
        clear_command,
        release_command,
    )
    from cell.interfaces.cli.terminal import print_line
    from gripper.errors import ServoFault
    from motion.errors import MotionError

    if config is None:
        raise ConfigError(
            "the config file of the cell is missing: `tactile-cell clear --config FILE`"
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
                cell.axes.clear_faults(reboot=reboot)
                for name, found in cell.axes.inspect().items():
                    print_line(f"{checked.name}: {name} is in {found}")
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
