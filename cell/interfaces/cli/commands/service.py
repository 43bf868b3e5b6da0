"""`service`: files of an installed cell: system files, a bundle for support."""

from pathlib import Path
from typing import Annotated

import typer

from cell.config.serve import ALL_CLOSED
from cell.errors import CellError
from cell.files import write_text
from cell.interfaces.cli import options, system_files as system
from cell.interfaces.cli.session import cell_config
from cell.interfaces.cli.support_bundle import write_bundle
from cell.interfaces.cli.terminal import ask, print_line, print_note


def install(
    config: options.Config = None,
    model: options.Model = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Write the files; asks before each file.")
    ] = False,
    root: Annotated[Path, typer.Option("--root", help="Folder to use as /.", hidden=True)] = Path(
        "/"
    ),
) -> None:
    """Print udev rules, system user and systemd unit. Nothing is written without --apply.

    The service is `tactile-cell serve` with this config and model. It starts with the machine and
    restarts when it was killed; a held part stays held.
    """
    served_with = () if model is None else ("--model", str(model.resolve()))
    checked = cell_config(config)
    files = system.system_files(checked, config, served_with)
    changed = False
    if config is not None and not checked.serve.ports:
        print_note(ALL_CLOSED)
    for path in (Path(system.program()[0]), config, model):
        if path is not None and (closed := system.closed_to_others(path)) is not None:
            print_note(
                f"{path}: the user {system.NAME} cannot read {closed}; move it, for example to "
                f"{system.STATE_FOLDER} or /opt, or permit it: chmod o+rX"
            )
    for file in files:
        path = root / file.path.relative_to("/")
        if apply:
            changed |= _write(path, file.text)
        else:
            print_line(f"# {path}\n{file.text}")
    if not apply:
        print_line("# nothing was written; add --apply to write these files")
    elif changed:
        print_line("now, as root:")
        for command in system.AFTER_WRITING:
            print_line(f"  {command}")


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


def _agreed(question: str) -> bool:
    """Ask a question at the terminal; the end of the input means no."""
    try:
        return ask(f"{question} y or n: ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def support(
    file: Annotated[Path, typer.Argument(help="Bundle to write (.zip).")],
    config: options.Config = None,
) -> None:
    """Pack config, versions, health, state, journal and the last recording for support.

    Tokens and secrets are removed. The service may run meanwhile. Check the bundle before you send
    it: it contains names of objects and machines.
    """
    names = write_bundle(file, cell_config(config))
    print_line(f"{file}: {', '.join(names)}")
