"""`commission`: guides from new parts to the first grasp; `hand bench`: measures one servo."""

from pathlib import Path
from typing import Annotated

import typer

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Engine, WizardAborted
from cell.commissioning.servo_bench import open_rig, run_bench
from cell.commissioning.servos import restore as restore_servos
from cell.commissioning.walk import all_steps
from cell.config.file import load_config
from cell.interfaces.cli.dialog import TerminalDialog
from cell.interfaces.cli.signals import as_interrupts
from cell.interfaces.cli.terminal import print_line, print_note


def _can(text: str | None) -> str | None:
    if text is not None and not all(text.partition(":")[::2]):
        raise typer.BadParameter(f"{text!r}: write INTERFACE:CHANNEL, for example socketcan:can0")
    return text


def commission(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the cell: findings, backups, config, record.")
    ] = Path(),
    servo_port: Annotated[
        str | None,
        typer.Option("--servo-port", help="Serial port of the servos [default: detected]."),
    ] = None,
    can: Annotated[
        str | None,
        typer.Option(
            "--can",
            help="CAN interface of the control unit as INTERFACE:CHANNEL, for example "
            "socketcan:can0 or slcan:/dev/ttyACM0 [default: detected].",
            callback=_can,
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            "-c",
            help="Config to begin with: its ports, and the values that no step measures "
            "[default: tactile-cell.yaml in FOLDER, else a new one].",
        ),
    ] = None,
    redo: Annotated[
        list[str] | None,
        typer.Option(
            "--redo", metavar="STEP", help="Repeat a step and all steps that depend on it."
        ),
    ] = None,
    restore: Annotated[
        bool,
        typer.Option(
            "--restore",
            help="Write the servos' original registers back, except ID and baud rate, and end.",
        ),
    ] = False,
) -> None:
    """Set up a new cell step by step, until its first grasp.

    Shows each write and motion before it is done. Leave at any time with q or Ctrl-C; the same
    command continues there. At the end the folder has tactile-cell.yaml and the record,
    commissioning.md.
    """
    given = {} if servo_port is None else {"gripper.port": servo_port}
    if can is not None:
        given["tactile.interface"], _, given["tactile.channel"] = can.partition(":")
    base = None if config is None else load_config(config)
    if base is not None and not base.simulated:
        given = {
            "gripper.port": base.gripper.port,
            "tactile.interface": base.tactile.interface,
            "tactile.channel": base.tactile.channel,
        } | given
    bench = Bench(folder, given=given, base=base)
    engine = Engine(all_steps(), bench)
    dialog = TerminalDialog()
    try:
        with as_interrupts():
            if restore:
                lines = restore_servos(
                    bench,
                    dialog,
                    servo_port or bench.gripper().port,
                    begin=lambda: engine.redo("servos"),
                )
                for line in lines:
                    print_line(line)
                return
            for key in redo or ():
                print_line(f"steps to repeat: {', '.join(engine.redo(key))}")
            files = engine.run(dialog)
    except KeyboardInterrupt:
        print_note("left; the results are kept. The same command continues there")
        raise typer.Exit(1) from None
    except WizardAborted as left:
        refused = "left: nothing was written; the same command shows the changes again"
        print_note(refused if restore else str(left))
        raise typer.Exit(1) from None
    dialog.finished(engine, files)


def bench(
    port: Annotated[str, typer.Argument(help="Serial port, for example /dev/ttyUSB0.")],
    folder: Annotated[Path, typer.Argument(help="Folder of log and result.")] = Path(),
) -> None:
    """Measure one servo in an hour: torque, friction, velocity register, heat, watchdog.

    The servo is alone on its line and no part of a gripper. Each step shows what it moves and
    asks first. You can skip it. Writes all readings (CSV) and the values (JSON), for `measured` of
    a servo in the config.
    """
    dialog = TerminalDialog()
    try:
        with as_interrupts(), open_rig(Bench(folder), port, dialog) as rig:
            files = run_bench(rig, dialog, folder)
    except (KeyboardInterrupt, WizardAborted):
        print_note(f"left: the torque is off; what was measured is in {folder}")
        raise typer.Exit(1) from None
    print_line(f"written: {', '.join(map(str, files))}")
