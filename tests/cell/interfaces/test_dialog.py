"""The wizard's face in a terminal: what a person reads before it is done."""

import io

import pytest

from cell.commissioning.engine import Left, Write
from cell.interfaces.cli import dialog as face
from cell.interfaces.cli.dialog import TerminalDialog

WRITES = [
    Write(where="servo 1", what="homing_offset (20)", before="0", after="12", undo="--restore"),
    Write(where="servo 2", what="drive_mode (10)", before="4", after="0", undo="--restore"),
]


@pytest.mark.parametrize("columns", ["40", "200"])
@pytest.mark.parametrize("typed", ["y", "n"])
def test_writes_are_shown_with_all_their_values_before_they_are_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], columns: str, typed: str
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(face, "ask", lambda _text: typed)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    if typed == "y":
        TerminalDialog().approve(WRITES)
    else:
        with pytest.raises(Left):
            TerminalDialog().approve(WRITES)
    shown = capsys.readouterr().out
    assert "servo 1: homing_offset (20): 0 -> 12" in shown
    assert "servo 2: drive_mode (10): 4 -> 0" in shown
    assert shown.count("way back: --restore") == 1
