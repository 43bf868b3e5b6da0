"""The commands, and the exit codes: 0 done, 1 the job failed or was interrupted, 2 wrong use."""

import signal
import sys
from typing import Annotated, NoReturn

import typer

from cell.errors import CellError, ConfigError
from cell.interfaces.cli.commands import (
    archive,
    backup,
    bench,
    calibrate,
    clear,
    commission,
    compare,
    config,
    doctor,
    evaluate,
    identify,
    install,
    plot,
    recordings,
    recover,
    release,
    replay,
    report,
    run,
    serve,
    simulate,
    sort,
    support,
    teach,
    train,
    zero,
)
from cell.interfaces.cli.signals import INTERRUPTED
from gripper.errors import GripperError
from tactile.errors import TactileError

_ENDED_BY_CTRL_C = 130
"""Exit code of typer after Ctrl-C; typer prints no message."""

app = typer.Typer(
    name="tactile-cell",
    help="Find out by touch what the gripper holds.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415

        typer.echo(f"tactile-cell {version('tactile-cell')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and end.", callback=_print_version),
    ] = False,
) -> None:
    """Find out by touch what the gripper holds."""


for command in (
    commission.commission,
    run.run,
    sort.sort,
    teach.teach,
    train.train,
    identify.identify,
    zero.zero,
    calibrate.calibrate,
    release.release,
    clear.clear,
    evaluate.evaluate,
    compare.compare,
    report.report,
    replay.replay,
    recover.recover,
    serve.serve,
    simulate.simulate,
    doctor.doctor,
    install.install,
    support.support,
    backup.backup,
    backup.restore,
):
    app.command()(command)
app.add_typer(config.app, name="config")
app.add_typer(recordings.app, name="recordings")
app.add_typer(archive.app, name="archive")
app.add_typer(plot.app, name="plot")
app.add_typer(bench.app, name="bench")


def main() -> None:
    """Run the command line and end the program with its exit code."""
    try:
        app()
    except SystemExit as end:
        if end.code == _ENDED_BY_CTRL_C:
            _fail(INTERRUPTED, 1)
        raise
    except ConfigError as error:
        _fail(str(error), 2)
    except (CellError, GripperError, TactileError) as error:
        _fail(str(error), 1)
    except OSError as error:
        # For example a full disk, or too many open files: only the system's message is known.
        from cell.fault_catalogue import error_text  # noqa: PLC0415  help does not need it

        _fail(error_text(error), 1)


def _fail(text: str, code: int) -> NoReturn:
    """Print the error and end; another Ctrl-C has no effect."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from cell.interfaces.cli.terminal import (  # noqa: PLC0415
        discard_unwritable_output,
        print_error,
    )

    print_error(text)
    discard_unwritable_output()
    sys.exit(code)
