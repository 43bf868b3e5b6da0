"""`hand bench`: measures one servo with an arm and a kitchen scale."""

from pathlib import Path
from typing import Annotated

import typer

from cell.commissioning.bench import Bench
from cell.commissioning.engine import WizardAborted
from cell.commissioning.servo_bench.result import run_bench
from cell.commissioning.servo_bench.rig import open_rig
from cell.interfaces.cli.dialog import TerminalDialog
from cell.interfaces.cli.signals import as_interrupts
from cell.interfaces.cli.terminal import print_line, print_note


def bench(
    port: Annotated[str, typer.Argument(help="Serial port, for example /dev/ttyUSB0.")],
    folder: Annotated[Path, typer.Argument(help="Folder of log and result.")] = Path(),
) -> None:
    """Measure one servo in an hour: torque, friction, velocity register, heat, watchdog.

    The servo is alone on its line and no part of a gripper. Each step says what it moves, asks
    first, and can be left out. Writes all readings (CSV) and the values (JSON), for `measured` of
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
