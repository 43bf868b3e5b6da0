"""`commission`: brings a cell up from the box to its first grasp."""

from pathlib import Path
from typing import Annotated

import typer


def _can(text: str | None) -> str | None:
    if text is not None and not all(text.partition(":")[::2]):
        raise typer.BadParameter(f"{text!r}: INTERFACE:CHANNEL, as socketcan:can0")
    return text


def commission(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the cell: findings, backups, config, record.")
    ] = Path(),
    servo_port: Annotated[
        str | None,
        typer.Option("--servo-port", help="Serial port of the servos [default: found]."),
    ] = None,
    can: Annotated[
        str | None,
        typer.Option(
            "--can",
            help="CAN interface of the control unit as INTERFACE:CHANNEL, as socketcan:can0 or "
            "slcan:/dev/ttyACM0 [default: found].",
            callback=_can,
        ),
    ] = None,
    redo: Annotated[
        list[str] | None,
        typer.Option("--redo", metavar="STEP", help="Forget a step and all that need it."),
    ] = None,
    restore: Annotated[
        bool,
        typer.Option("--restore", help="Write the servos' registers back as they came, and end."),
    ] = False,
) -> None:
    """Bring a cell up from the box to its first grasp, step by step.

    Shows each write and motion before it is done. Leave at any moment, with q or Ctrl-C; the same
    command goes on there. Writes tactile-cell.yaml into the folder at the end.
    """
    from cell.commissioning.backup import restore as restore_servos
    from cell.commissioning.bench import Bench
    from cell.commissioning.engine import Engine, Left
    from cell.commissioning.walk import all_steps
    from cell.interfaces.cli.dialog import TerminalDialog
    from cell.interfaces.cli.signals import as_interrupts
    from cell.interfaces.cli.terminal import print_line, print_note

    given = {} if servo_port is None else {"gripper.port": servo_port}
    if can is not None:
        given["tactile.interface"], _, given["tactile.channel"] = can.partition(":")
    bench = Bench(folder, given=given)
    engine = Engine(all_steps(), bench)
    dialog = TerminalDialog()
    try:
        with as_interrupts():
            if restore:
                lines = restore_servos(bench, dialog, servo_port or bench.gripper().port)
                for line in lines:
                    print_line(line)
                return
            for key in redo or ():
                print_line(f"to be done again: {', '.join(engine.redo(key))}")
            files = engine.run(dialog)
    except KeyboardInterrupt:
        print_note("left; what was found is kept. The same command goes on there")
        raise typer.Exit(1) from None
    except Left as left:
        print_note(str(left))
        raise typer.Exit(1) from None
    print_line(f"commissioned: {', '.join(map(str, files))}")
