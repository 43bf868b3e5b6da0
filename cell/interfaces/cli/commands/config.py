"""`config init`, `config check`: config files."""

from pathlib import Path
from typing import Annotated

import typer

import cell.config
from cell.config.file import SHORT_KEYS, config_text, load_config, schema_text
from cell.errors import ConfigError
from cell.files import write_text
from cell.interfaces.cli import options
from cell.interfaces.cli.terminal import print_line, print_note
from cell.plugins import RECOGNIZERS
from cell.simulation import simulator_settings


def _examples() -> dict[str, Path]:
    """Return the example configs of the package by name: the files of config/."""
    folder = Path(cell.config.__file__).with_name("examples")
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _known_example(name: str | None) -> str | None:
    if name is not None and name not in _examples():
        raise typer.BadParameter(
            f"no example is named {name!r}; use one of {', '.join(_examples())}"
        )
    return name


def init(
    path: Annotated[Path, typer.Argument(help="File to write.")] = options.FOLDER_CONFIG,
    example: Annotated[
        str | None,
        typer.Option(
            "--example",
            help="Example to begin with, for example paper-gripper or pinch-13x6 [default: the "
            "simulated cell].",
            callback=_known_example,
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    short: Annotated[
        bool, typer.Option("--short", help="Write only the keys that most users set.")
    ] = False,
) -> None:
    """Write a config file with explained keys, and its schema."""
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; name another file or add --force")
    config = load_config(None if example is None else _examples()[example])
    text = config_text(config, keys=SHORT_KEYS if short else ("",))
    schema_path = path.parent / "tactile-cell.schema.json"
    write_text(path, text, error=ConfigError, what="config")
    write_text(schema_path, schema_text(), error=ConfigError, what="schema")
    print_line(f"wrote {path} and {schema_path}")


def check(
    path: Annotated[Path, typer.Argument(help="Config file.")] = options.FOLDER_CONFIG,
) -> None:
    """Check a config file."""
    config = load_config(path)
    try:
        RECOGNIZERS[config.recognition.recognizer]
    except ConfigError as error:
        raise ConfigError(f"{path}: recognition.recognizer: {error}") from error
    if config.simulated:
        simulator_settings(config)
    for note in config.notes:
        print_note(note)
    kind = "simulated ports" if config.simulated else "real ports"
    print_line(f"{path}: valid: {config.name}, {kind}")
