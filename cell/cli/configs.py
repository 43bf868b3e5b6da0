"""Commands for config files."""

from pathlib import Path
from typing import Annotated

import typer

from cell.cli.options import ConfigOption
from cell.cli.output import say
from cell.config import CellConfig
from cell.config_file import config_text, load_config, schema_text
from cell.errors import ConfigError
from cell.files import write_text
from cell.layouts import layout_from_config
from cell.simulation import simulator_settings
from tactile.dbc import dbc_text


def init(
    path: Annotated[Path, typer.Argument(help="File to write.")] = Path("tactile-cell.yaml"),
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write a config file with every key, its meaning, unit and default, and the schema beside."""
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; name another file or add --force")
    schema_path = path.parent / "tactile-cell.schema.json"
    write_text(path, config_text(CellConfig()), error=ConfigError, what="config")
    write_text(schema_path, schema_text(), error=ConfigError, what="schema")
    say(f"wrote {path} and {schema_path}")


def check(path: Annotated[Path, typer.Argument(help="Config file.")]) -> None:
    """Check a config file; complaints name file, line, key and limit."""
    config = load_config(path)
    if config.simulated:
        simulator_settings(config)
    kind = "the simulated cell" if config.simulated else "real ports"
    say(f"{path}: valid ({config.name}; {kind})")


def schema(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write instead of printing.")
    ] = None,
) -> None:
    """Print the JSON schema of the config file."""
    if output is None:
        typer.echo(schema_text(), nl=False)
    else:
        write_text(output, schema_text(), error=ConfigError, what="schema")
        say(f"wrote {output}")


def dbc(
    config: ConfigOption = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write instead of printing.")
    ] = None,
) -> None:
    """Write the cell's CAN traffic as a DBC file, for cantools, SavvyCAN, CANalyzer and others."""
    tactile = (CellConfig() if config is None else load_config(config)).tactile
    text = dbc_text(
        layout_from_config(tactile),
        node_id=tactile.node_id,
        sync_period_ms=round(tactile.sync_period_ms),
        heartbeat_ms=round(tactile.heartbeat_ms),
    )
    if output is None:
        typer.echo(text, nl=False)
    else:
        write_text(output, text, error=ConfigError, what="DBC file")
        say(f"wrote {output}")
