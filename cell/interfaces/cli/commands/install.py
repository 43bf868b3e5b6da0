"""`service install`: udev rules, user and systemd unit of a cell that runs as a service."""

from pathlib import Path
from typing import Annotated

import typer

from cell.config.serve import ALL_CLOSED
from cell.data.files import write_text
from cell.errors import CellError
from cell.interfaces.cli import system_files as system
from cell.interfaces.cli.options import ConfigOption, ModelOption
from cell.interfaces.cli.session import cell_config
from cell.interfaces.cli.terminal import ask, print_line, print_note


def install(
    config: ConfigOption = None,
    model: ModelOption = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Write the files; asks before each file.")
    ] = False,
    remove: Annotated[
        bool, typer.Option("--remove", help="Remove the files; asks before each file.")
    ] = False,
    root: Annotated[Path, typer.Option("--root", help="Folder to use as /.", hidden=True)] = Path(
        "/"
    ),
) -> None:
    """Print udev rules, user and systemd unit of the service. Nothing is written without --apply.

    The service is `tactile-cell serve` with this config and model. It starts with the machine and
    restarts when it was killed; a held part stays held.
    """
    if apply and remove:
        raise typer.BadParameter("--apply and --remove exclude each other")
    options = () if model is None else ("--model", str(model.resolve()))
    checked = cell_config(config)
    files = system.system_files(checked, config, options)
    changed = False
    if not remove and config is not None and not checked.serve.ports:
        print_note(ALL_CLOSED)
    for path in () if remove else (Path(system.program()[0]), config, model):
        if path is not None and (closed := system.closed_to_others(path)) is not None:
            print_note(
                f"{path}: the user {system.NAME} cannot read {closed}; move it, for example to "
                f"{system.STATE_FOLDER} or /opt, or permit it: chmod o+rX"
            )
    if remove:
        _print_commands("before", system.BEFORE_REMOVING)
    for file in files:
        path = root / file.path.relative_to("/")
        if remove:
            changed |= _remove(path)
        elif apply:
            changed |= _write(path, file.text)
        else:
            print_line(f"# {path}\n{file.text}")
    if not remove and not apply:
        print_line("# nothing was written; add --apply to write these files")
    elif changed:
        _print_commands("now", system.AFTER_REMOVING if remove else system.AFTER_WRITING)


def _write(path: Path, text: str) -> bool:
    """Write a file if the person agrees; return whether it has changed."""
    before = path.read_text("utf-8") if path.exists() else None
    if before == text:
        print_line(f"{path}: already up to date")
        return False
    print_line(text)
    if not _agreed(f"{'overwrite' if before else 'write'} {path}?"):
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text, error=CellError, what="system file")
    path.chmod(0o644)
    return True


def _remove(path: Path) -> bool:
    """Remove a file if the person agrees; return whether it is gone now."""
    if not path.exists():
        print_line(f"{path}: not there")
        return False
    if not _agreed(f"remove {path}?"):
        return False
    path.unlink()
    return True


def _agreed(question: str) -> bool:
    """Ask a question at the terminal; the end of the input means no."""
    try:
        return ask(f"{question} y or n: ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _print_commands(when: str, commands: tuple[str, ...]) -> None:

    print_line(f"{when}, as root:")
    for command in commands:
        print_line(f"  {command}")
