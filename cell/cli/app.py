"""The commands and how errors become exit codes: 0 done, 1 the job failed, 2 wrong use."""

import signal
import sys
from typing import NoReturn

import typer

from cell.cli import cells, configs, figures, gauging, identifying, recordings, simulated
from cell.cli.output import complain, give_up_output
from cell.cli.stopping import INTERRUPTED
from cell.errors import CellError, ConfigError
from gripper.errors import GripperError
from tactile.errors import TactileError

app = typer.Typer(
    name="tactile-cell",
    help="Find out by touch what the gripper holds.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
config_app = typer.Typer(no_args_is_help=True, help="Config files: init, check, schema.")

app.command()(cells.run)
app.command()(cells.teach)
app.command()(figures.train)
app.command()(identifying.identify)
app.command()(gauging.calibrate)
app.command()(cells.release)
app.command()(figures.evaluate)
app.command()(figures.replay)
app.command()(recordings.recover)
app.command()(simulated.simulate)
app.command()(simulated.doctor)
app.command()(configs.dbc)
app.add_typer(config_app, name="config")
config_app.command("init")(configs.init)
config_app.command("check")(configs.check)
config_app.command("schema")(configs.schema)


def main() -> None:
    """Run the command line; the exit code says how it went."""
    try:
        app()
    except ConfigError as error:
        _end(str(error), 2)
    except (CellError, GripperError, TactileError) as error:
        _end(str(error), 1)
    except OSError as error:
        # A full disk behind the output, no more open files: the system's word is all there is.
        _end(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}", 1)
    except KeyboardInterrupt:
        _end(INTERRUPTED, 1)


def _end(text: str, code: int) -> NoReturn:
    """Say why, and end; whoever presses Ctrl-C once more is told the same."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    complain(text)
    give_up_output()
    signal.signal(signal.SIGINT, before)
    sys.exit(code)
