"""The wizard's questions in a terminal: what is typed, taken and refused."""

import io
import sys
from collections.abc import Callable
from dataclasses import replace

import pytest
from rich.console import Console

from cell.checks.findings import Finding, ProposedChange, Verdict
from cell.commissioning.engine import Choice, NumberRange, Question, WizardAborted
from cell.commissioning.ports import PortsStep
from cell.interfaces.cli import dialog, terminal
from cell.interfaces.cli.dialog import TerminalDialog

CHOICES = (
    Choice(key="a", text="the first", picture="  | |"),
    Choice(key="b", text="the second [x]"),
)
WRITE = ProposedChange(where="servo 1", what="id (7)", before="1", after="2", undo="by --restore")


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., TerminalDialog]:
    def type_in(*lines: str) -> TerminalDialog:
        text = io.StringIO("".join(f"{line}\n" for line in lines))
        monkeypatch.setattr(sys, "stdin", text)
        return TerminalDialog()

    return type_in


@pytest.mark.parametrize(
    ("lines", "answer"), [(["2"], "b"), (["b"], "b"), ([""], "a"), (["7", "x", "1"], "a")]
)
def test_choices_are_taken_by_number_name_or_enter(typed, lines, answer, capsys) -> None:
    question = Question(key="q", text="Which?", choices=CHOICES, default="a")
    assert typed(*lines).ask(question) == answer
    assert "  1  the first (Enter)\n  | |\n  2  the second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("lines", "answer"), [(["10,5"], 10.5), (["", "0", "nan", "ten", "99"], 99.0)]
)
def test_numbers_have_a_range_and_either_point(typed, lines, answer) -> None:
    question = Question(key="q", text="?", number=NumberRange(lowest=1, highest=100, unit="mm"))
    assert typed(*lines).ask(question) == answer


def test_texts_are_taken_as_they_are(typed) -> None:
    assert typed("", "FT 1").ask(Question(key="q", text="Name?")) == "FT 1"


def test_a_watched_value_does_not_hold_up_a_pipe(typed) -> None:
    typed("").confirm("q", "Move it.", watch=lambda: "1 deg")


def test_a_terminal_shows_a_watched_value_above_the_prompt_and_live_ones_in_place(
    typed, monkeypatch
) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=20)
    monkeypatch.setattr(dialog, "out", console)
    monkeypatch.setattr(terminal, "out", console)
    waits = iter([False, False, True])
    monkeypatch.setattr(dialog, "_input_waits", lambda: next(waits))
    angles = iter(["1 deg\x1b", "2 deg" * 9])
    asked = typed("")
    asked.live("scan", "57600 bit/s")
    asked.live("scan", "1 Mbit/s")
    asked.confirm("q", "Move it.", watch=lambda: next(angles))
    shown = console.file.getvalue()
    assert shown.startswith("\r\x1b[2Kscan 57600 bit/s\r\x1b[2Kscan 1 Mbit/s\nMove it.\n")
    for angle in ("1 deg", ("2 deg" * 9)[:19]):
        assert f"\x1b7\x1b[1A\r\x1b[2K{angle}\x1b8" in shown


@pytest.mark.parametrize("lines", [["q"], []])
def test_q_and_the_end_of_input_leave(typed, lines) -> None:
    with pytest.raises(WizardAborted, match="run `tactile-cell commission` again"):
        typed(*lines).ask(Question(key="q", text="?"))


def test_writes_are_shown_and_refused_unless_yes_is_typed(typed, capsys) -> None:
    zero = replace(WRITE, what="drive_mode (10)", before="0", after="4")
    typed("", "maybe", "y").approve([WRITE, zero])
    shown = capsys.readouterr().out
    assert "servo 1: id (7): 1 -> 2" in shown
    assert "servo 1: drive_mode (10): 0 -> 4" in shown
    assert shown.count("undo: by --restore") == 1
    for refusal in ("n", "q"):
        with pytest.raises(WizardAborted):
            typed(refusal).approve([WRITE])


def test_findings_are_printed_with_their_lines(typed, capsys) -> None:
    asked = typed()
    step = PortsStep()
    asked.start_step(step, 1, 3)
    asked.live("scan", "57600 bit/s")
    asked.found(step, Finding(status=Verdict.WARN, lines=["16 ms [slow]"]))
    shown = capsys.readouterr().out
    assert "1/3 Ports" in shown
    assert "warn Ports" in shown
    assert "16 ms [slow]" in shown
    assert terminal.out.is_terminal is False
