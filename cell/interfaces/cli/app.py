"""The commands, and the exit codes: 0 done, 1 the job failed or was interrupted, 2 wrong use."""

import signal
import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import version as version_of
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from cell.errors import ConfigError
from cell.fault_catalogue import EXPECTED_ERRORS, error_text, fault_number
from cell.interfaces.cli.signals import INTERRUPTED

_ENDED_BY_CTRL_C = 130
"""Exit code of typer after Ctrl-C; typer prints no message."""


# fmt: off
_GROUPS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "model": {
        "train": ("model:train", "Train a recognizer on data sets and write a model file."),
        "calibrate": ("model:calibrate", "Correct a model for the drift since teaching."),
        "evaluate": ("model:evaluate", "Measure recognizers on recorded grasps."),
    },
    "config": {
        "init": ("config:init", "Write a config file with explained keys, and its schema."),
        "check": ("config:check", "Check a config file."),
    },
    "hand": {
        "zero": ("hand:zero", "Close the empty fingers on each other; measure zero and gains."),
        "release": ("hand:release", "Release a part that an earlier run left in the grip."),
        "clear": ("hand:clear", "Show errors of servos and axes, and clear them."),
        "bench": ("commission:bench", "Measure one servo on a bench."),
    },
    "service": {
        "install": ("service:install", "Print udev rules, system user and systemd unit."),
        "support": ("service:support", "Pack files for remote support."),
    },
    "recording": {
        "report": ("recording:report", "Write the report page of a recording."),
        "plot": ("recording:plot", "Draw a grasp (PNG, SVG)."),
        "list": ("recording:list_recordings", "List the recordings in a folder."),
        "mark": ("recording:mark", "Mark recordings, so that they are never deleted."),
        "recover": ("recording:recover", "Save the undamaged data of a damaged recording."),
    },
    "archive": {
        "add": ("archive:add", "Add the new grasps of recordings and data sets."),
        "report": ("archive:report", "Write the page of an archive: confusions, drift, ageing."),
    },
}
"""Commands of each group: module and function below `cell.interfaces.cli.commands`, and help."""
_PANELS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "Work": {
        "run": ("run:run", "Teach objects and identify each of them: the main job."),
        "teach": ("teach:teach", "Grasp a known object, or a drawing of it, for a data set."),
        "model": ("", "Models of taught objects: train, calibrate, evaluate."),
        "identify": ("identify:identify", "Grasp a part and name it, or name recorded grasps."),
        "sort": ("sort:sort", "Identify parts and release each at its place."),
    },
    "Set up": {
        "commission": ("commission:commission", "Set up a new cell, up to its first force."),
        "config": ("", "Config files: init, check."),
        "doctor": ("doctor:doctor", "Check ports, servos and control unit."),
        "simulate": ("simulate:simulate", "Run the simulated cell for other programs."),
    },
    "Operate": {
        "serve": ("serve:serve", "Run the cell for people, PLCs, robots and other hosts."),
        "hand": ("", "Gripper and sensor: zero, release, clear, bench."),
        "service": ("", "The cell as a systemd service: install, support."),
    },
    "Look back": {
        "recording": ("", "Recordings: report, plot, list, mark, recover."),
        "archive": ("", "Grasps of many cells and days: add, report."),
    },
}
"""The commands by their purpose; a name without a place is one of `_GROUPS`."""
# fmt: on


class LazyCommand(TyperCommand):
    """A command whose module is loaded when it is called."""

    def __init__(self, name: str, place: str, text: str) -> None:
        super().__init__(name, help=text)
        self._module, _, self._function = place.partition(":")

    def load(self) -> Any:
        """Return the command itself."""
        module = import_module(f"cell.interfaces.cli.commands.{self._module}")
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        alone.command(self.name)(getattr(module, self._function))
        return typer.main.get_command(alone)

    def make_context(self, *given: Any, **more: Any) -> Any:
        """Return the context of the command itself."""
        return self.load().make_context(*given, **more)


class Group(TyperGroup):
    """The program, or a group of commands: its help lists them by panels and loads none."""

    def __init__(
        self, panels: Mapping[str, Mapping[str, tuple[str, str]]] = _PANELS, **settings: Any
    ) -> None:
        self._panels = panels
        made = {
            name: LazyCommand(name, place, text)
            if place
            else Group({"Commands": _GROUPS[name]}, name=name, help=text)
            for panel in panels.values()
            for name, (place, text) in panel.items()
        }
        always = {"commands": made, "no_args_is_help": True, "rich_markup_mode": None}
        super().__init__(**settings | always)

    def get_params(self, ctx: Any) -> Any:
        """Return the options; the one that only prints the completion is not in the help."""
        options: list[Any] = super().get_params(ctx)
        for option in options:
            option.hidden = option.name == "show_completion"
        return options

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each panel, with equal columns."""
        width = max(map(len, self.commands))
        for panel, commands in self._panels.items():
            with formatter.section(panel):
                formatter.write_dl(
                    [(f"{name:<{width}}", text) for name, (_, text) in commands.items()]
                )


app = typer.Typer(
    name="tactile-cell",
    cls=Group,
    help="Identify parts by touch.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"tactile-cell {version_of('tactile-cell')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and end.", callback=_print_version)
    ] = False,
) -> None:
    """Identify parts by touch."""


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
    except EXPECTED_ERRORS as error:
        _fail(str(error), 1, fault=fault_number(error))
    except OSError as error:
        # For example a full disk, or too many open files: only the system's message is known.
        _fail(error_text(error), 1)


def _fail(text: str, code: int, *, fault: int = 0) -> NoReturn:
    """Print the error and end; another Ctrl-C has no effect."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from cell.interfaces.cli.terminal import print_error  # noqa: PLC0415

    print_error(text, fault=fault)
    sys.exit(code)
