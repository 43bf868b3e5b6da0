"""`clear`: acknowledges errors that servos and axes hold from an earlier run."""

from typing import Annotated

import typer

from cell.interfaces.cli.commands.release import NamedConfigOption


def clear(
    config: NamedConfigOption = None,
    reboot: Annotated[
        bool,
        typer.Option(
            "--reboot",
            help="Restart servos that report an error; what they still hold may fall.",
        ),
    ] = False,
) -> None:
    """Show torque and errors of servos and axes, and clear them; nothing moves.

    A servo that overload, heat or a shock has made switch its torque off stays without it until it
    is rebooted. A part that other servos hold stays held. Drives of axes need no reboot, and the
    control unit need not be there.
    """
    from cell.build import build_cell
    from cell.errors import CellError, ConfigError
    from cell.interfaces.cli.session import (
        cell_config,
        clear_command,
        missing_lines,
        release_command,
    )
    from cell.interfaces.cli.signals import END_WITHIN_S, stopping
    from cell.interfaces.cli.terminal import ask, print_line
    from gripper.errors import ServoFault
    from motion.errors import MotionError

    if config is None:
        raise ConfigError(
            "name the cell whose servos are meant: `tactile-cell clear --config FILE`"
        )
    checked = cell_config(config)
    cell = build_cell(checked, mover=lambda _pose: False, ask=ask, partial=True)
    missing_lines(cell)
    try:
        with stopping(cell.controller.cancel, end_within_s=END_WITHIN_S):
            before = cell.controller.hand.conditions()
            for condition in before:
                print_line(f"{checked.name}: {condition}")
            cell.controller.clear(reboot=reboot)
            after = cell.controller.hand.conditions()
            if cell.axes is not None:
                cell.axes.clear_faults(reboot=reboot)
                for name, found in cell.axes.inspect().items():
                    print_line(f"{checked.name}: {name} is in {found}")
    except ServoFault as error:
        raise CellError(f"{error}: {clear_command(config)}") from error
    except MotionError as error:
        raise CellError(str(error)) from error
    finally:
        cell.close()
    for condition in after:
        if condition not in before:
            print_line(f"{checked.name}: after the reboot {condition}")
    if any(condition.torque_on for condition in after):
        print_line(f"a part may be in the grip; to let go of it: `{release_command(config)}`")
    bad = [str(condition) for condition in after if condition.error_bits or not condition.answers]
    if bad:
        raise CellError(f"{'; '.join(bad)}: remedy the cause, then clear again")
