"""`commission`: guides from new parts to the first grasp; `hand bench`: measures one servo."""

import select
import sys
from collections.abc import Sequence
from contextlib import suppress
from os.path import realpath
from pathlib import Path
from typing import Annotated

import typer

from cell.commissioning.bench import CONFIG_NAME, Bench
from cell.commissioning.engine import (
    RESUME,
    Answers,
    Dialog,
    Engine,
    Limits,
    Step,
    Watch,
    WizardAborted,
    leave,
)
from cell.commissioning.findings import Notes, ProposedChange, Verdict
from cell.commissioning.servo_bench import open_rig, run_bench
from cell.commissioning.servos import restore as restore_servos
from cell.commissioning.walk import all_steps
from cell.config.file import load_config
from cell.errors import ConfigError
from cell.interfaces.cli.signals import as_interrupts
from cell.interfaces.cli.terminal import ask, out, plain_text, print_line, print_note

_LEAVE = "q"
"""Answer that leaves the wizard."""
_LOOK_S = 0.1
"""Time in s between two readings of a live value."""
_LINE_START = "\r\x1b[2K"
"""Clears the line and returns to its start (ECMA-48: CR, EL)."""
_LINE_UP, _SAVE, _RESTORE = "\x1b[1A", "\x1b7", "\x1b8"
"""One line up (ECMA-48: CUU); save and restore the place of the cursor (DECSC, DECRC)."""
_COLOURS = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}


class TerminalDialog(Dialog):
    """Implements `cell.commissioning.engine.Dialog` on standard input and output."""

    def __init__(self) -> None:
        self._running = False

    def start_step(self, step: Step, number: int, count: int) -> None:
        """Print the step that begins."""
        self.end_line()
        out.print(f"\n[bold]{number}/{count} {plain_text(step.title)}[/]")
        print_line(step.purpose)

    def show(self, step: Step, notes: Notes) -> None:
        """Print the findings of a step."""
        self.end_line()
        verdict = notes.status
        out.print(f"[{_COLOURS[verdict]}]{verdict.value}[/] {plain_text(step.title)}")
        for line in notes.lines:
            print_line(f"  {line}")

    def say(self, text: str) -> None:
        """Print a text."""
        self.end_line()
        print_line(text)

    def live(self, name: str, value_text: str) -> None:
        """Print a value over its previous one; without a terminal print nothing."""
        if out.is_terminal:
            out.file.write(f"{_LINE_START}{_one_line(f'{name} {value_text}')}")
            out.file.flush()
            self._running = True

    def choose(
        self, key: str, text: str, answers: Answers, default: str | None = None, watch: Watch = None
    ) -> str:
        """Ask until the answer is valid; raises `WizardAborted` at q and at the end of input."""
        self.say(text)
        keys = {"": default} | {answer: answer for answer in answers}
        for number, (answer, choice) in enumerate(answers.items(), start=1):
            line, _, picture = choice.partition("\n")
            print_line(f"  {number}  {line}{' (Enter)' if answer == default else ''}")
            if picture:
                print_line(picture)
            keys[str(number)] = answer
        while (chosen := keys.get(self._typed(f"({_LEAVE}: leave)> ", watch))) is None:
            print_line(
                f"Press Enter when it is done, or {_LEAVE} to leave."
                if [*answers] == [default]
                else f"type a number from 1 to {len(answers)}"
            )
        return chosen

    def number(
        self, key: str, text: str, limits: Limits, default: float | None = None, watch: Watch = None
    ) -> float:
        """Ask as `choose`."""
        self.say(text)
        low, high, unit = limits
        prompt = f"{unit}{'' if default is None else f' [{default}]'} ({_LEAVE}: leave)> "
        while True:
            typed = self._typed(prompt, watch)
            if not typed and default is not None:
                return default
            with suppress(ValueError):
                if low <= (value := float(typed.replace(",", "."))) <= high:
                    return value
            print_line(f"type a number from {low:g} to {high:g} {unit}")

    def ask_consent(self, writes: Sequence[ProposedChange]) -> None:
        """Print a batch of writes and ask once for approval."""
        self.end_line()
        for write in writes:
            print_line(f"  {write.where}: {write.what}: {write.before} -> {write.after}")
        for undo in dict.fromkeys(write.undo for write in writes):
            print_line(f"  undo: {undo}")
        while True:
            typed = self._typed("Do this? y, or n to leave: ").lower()
            if typed in {"y", "yes"}:
                return
            if typed in {"n", "no"}:
                leave("refused; nothing was written or moved")

    def finished(self, engine: Engine, files: Sequence[Path]) -> None:
        """Print the errors that were corrected, and the files that were written."""
        print_line("Errors found and corrected:" if engine.corrected else "No errors were found.")
        for line in engine.corrected:
            print_line(f"  {line}")
        print_line(f"commissioned: {', '.join(map(str, files))}")

    def _typed(self, prompt: str, watch: Watch = None) -> str:
        """Return the typed line; the line above shows what ``watch`` returns."""
        live = watch is not None and out.is_terminal
        out.print(("\n" if live else "") + plain_text(prompt), end="", soft_wrap=True)
        try:
            # A signal just before the read would otherwise wait until a line is typed.
            while not _input_waits():
                text = "" if watch is None else watch()
                if live:
                    out.file.write(f"{_SAVE}{_LINE_UP}{_LINE_START}{_one_line(text)}{_RESTORE}")
                    out.file.flush()
            typed = ask("").strip()
        except EOFError:
            leave("the input ended")
        if typed == _LEAVE:
            leave("on request")
        return typed

    def end_line(self) -> None:
        """End the line of a live value."""
        if self._running:
            out.file.write("\n")
            self._running = False


def _input_waits() -> bool:
    """Wait 0.1 s for input; return whether there is input, or the end of it."""
    try:
        return bool(select.select([sys.stdin], [], [], _LOOK_S)[0])
    except (OSError, ValueError):
        # The input is no file of the system: reading it does not wait.
        return True


def _one_line(text: str) -> str:
    """Return a text cut to one line of the terminal: a longer text could not be overwritten."""
    return "".join(sign for sign in text.strip() if sign.isprintable())[: out.width - 1]


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
            "--redo",
            metavar="STEP",
            help="Repeat a step and all steps that depend on it: "
            f"{', '.join(step.key for step in all_steps())}.",
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
    command continues with that step. At the end the folder has tactile-cell.yaml and the record,
    commissioning.md.
    """
    given = {} if servo_port is None else {"gripper.port": servo_port}
    if can is not None:
        given["tactile.interface"], _, given["tactile.channel"] = can.partition(":")
    if config and (own := folder / CONFIG_NAME).exists() and not own.samefile(config):
        raise ConfigError(f"{own} exists: leave out --config, or move the file away to begin anew")
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
            current = {key: bench.settings.get(key, value) for key, value in given.items()}
            other = [key for key in given if realpath(current[key]) != realpath(given[key])]
            steps = ["ports" if key == "gripper.port" else "unit" for key in other]
            if keys := [*steps, *(redo or ())]:
                print_line(f"steps to repeat: {', '.join(engine.affected(*keys))}")
                for key in other:
                    text = f"{key} was {current[key]}, now {given[key]} is named."
                    dialog.confirm(key, f"{text} Forget what these steps have found?", "forget it")
                engine.redo(*keys)
            files = engine.run(dialog)
    except KeyboardInterrupt:
        dialog.end_line()
        print_note(f"left. {RESUME}")
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

    Connect only this servo to the line. Take it out of the gripper. Each step shows what it moves
    and asks first. You can skip it. Writes all readings (CSV) and the values (JSON), for
    `measured` of a servo in the config.
    """
    dialog = TerminalDialog()
    try:
        with as_interrupts(), open_rig(Bench(folder), port, dialog) as rig:
            files = run_bench(rig, dialog, folder)
    except (KeyboardInterrupt, WizardAborted):
        dialog.end_line()
        kept = f"; measured values: in {folder}" if folder.exists() else ""
        print_note(f"left: cut the supply if the arm still presses{kept}")
        raise typer.Exit(1) from None
    print_line(f"written: {', '.join(map(str, files))}")
