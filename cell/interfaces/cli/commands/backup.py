"""`backup` and `restore`: all files and registers of a cell in one file."""

from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import FOLDER_CONFIG, ConfigOption


def backup(
    file: Annotated[Path, typer.Argument(help="Backup to write (.zip).")],
    config: ConfigOption = None,
    model: Annotated[
        list[Path] | None,
        typer.Option("--model", "-m", help="Model in another folder; repeat for several."),
    ] = None,
    devices: Annotated[
        bool, typer.Option(help="Also read the registers of the servos and the control unit.")
    ] = True,
) -> None:
    """Write config, zero, models, data sets, photos, findings and registers to one file.

    It takes the files in the folder of the config. Nothing is written to a device.
    """
    from cell.commissioning.bench import Bench
    from cell.commissioning.cell_backup import back_up
    from cell.config.file import load_config
    from cell.errors import ConfigError
    from cell.interfaces.cli.terminal import print_line, print_note

    if config is None:
        raise ConfigError(f"{FOLDER_CONFIG} is not in this folder; name a config with --config")
    checked = load_config(config)
    bench = Bench(config.parent, base=checked) if devices else None
    made = back_up(file, config, checked, models=model or (), bench=bench)
    for text in made.missing:
        print_note(f"not in the backup: {text}")
    n_bytes = sum(one.n_bytes for one in made.members.values())
    print_line(f"{file}: {made.name}, {len(made.members)} files, {n_bytes / 1e6:.1f} MB")


def restore(
    file: Annotated[Path | None, typer.Argument(help="Backup to restore.")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="Folder of the cell.")] = Path(),
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    undo: Annotated[
        bool, typer.Option("--undo", help="Undo the changes of the last restore.")
    ] = False,
    servos: Annotated[
        bool,
        typer.Option("--servos", help="Restore the registers of the servos only, no files."),
    ] = False,
    unit: Annotated[
        bool,
        typer.Option("--unit", help="Write the objects of the control unit back; no file changes."),
    ] = False,
) -> None:
    """Restore a backup: shows the differences, and asks before the first write.

    The ports of the config in the folder stay. End other programs of the cell first.
    """
    from cell.commissioning.bench import Bench
    from cell.commissioning.cell_backup import UNDO, restore, restore_registers, restore_unit
    from cell.commissioning.engine import WizardAborted
    from cell.errors import CellError
    from cell.interfaces.cli.dialog import TerminalDialog
    from cell.interfaces.cli.terminal import print_line, print_note

    if (file is None) is not undo or (undo and (servos or unit)):
        raise typer.BadParameter("name a backup, or --undo")
    dialog = TerminalDialog(approved=yes)
    path = folder / UNDO if file is None else file
    if file is None and not path.exists():
        raise CellError(f"there is nothing to undo: {path}, which a restore writes, is missing")
    try:
        bench, lines = Bench(folder) if servos or unit else None, list[str]()
        if bench is None:
            lines = restore(path, folder, dialog.approve)
        if bench and servos:
            lines += restore_registers(path, bench.base, bench, dialog)
        if bench and unit:
            lines += restore_unit(path, bench, dialog)
    except WizardAborted as left:
        print_note(str(left))
        raise typer.Exit(1) from None
    for line in lines:
        print_line(line)
