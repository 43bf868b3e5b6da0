"""Named faults of sensor boards on serial lines."""

from simulator.boards.uskin import UskinSettings
from simulator.errors import SimulatorSettingsError
from simulator.faults.entry import (
    SHARE,
    FaultEntry,
    FaultKind,
    Number,
    Target,
    Undo,
    knob_fault,
)

_FINGER = Number("finger", 0, 1, default=0, whole=True)
"""Finger of the board."""


def _check(target: Target) -> None:
    if not target.devices.boards:
        raise SimulatorSettingsError("this cell has no sensor boards on serial lines")


def _check_uskin(target: Target) -> None:
    if not isinstance(target.devices.settings.boards, UskinSettings):
        raise SimulatorSettingsError("this cell has no sensor boards on CAN")


def _unplugged(target: Target) -> Undo:
    return target.plugs[f"board{int(target.number)}"]()


def _of_finger(name: str, kind: FaultKind, meaning: str, knob: str) -> FaultEntry:
    def fingers(target: Target) -> object:
        return getattr(target.devices.faults.boards, knob) | {int(target.number)}

    check = _check_uskin if name.startswith("uskin.") else _check
    return knob_fault(name, kind, meaning, knob, _FINGER, position=fingers, check=check)


# fmt: off
BOARD = (
    FaultEntry("board.unplugged", FaultKind.UNPLUGGED, "this finger's board is unplugged",
               _unplugged, "board_plug", _FINGER, check=_check),
    _of_finger("board.off", FaultKind.OFF, "the board of this finger sends nothing", "silent"),
    _of_finger("board.frozen", FaultKind.STUCK, "the board of this finger always sends one frame",
               "frozen"),
    _of_finger("board.marked", FaultKind.WRONG,
               "the samples of this finger's board always contain a header at one place", "marked"),
    knob_fault("board.repeated", FaultKind.WRONG, "frames of both boards repeat the one before",
               "repeated", SHARE, check=_check),
    knob_fault("board.lost_byte", FaultKind.INTERMITTENT, "frames of both boards lack one byte",
               "lost_byte", SHARE, check=_check),
    knob_fault("board.torn", FaultKind.INTERMITTENT, "frames of both boards end in the middle",
               "torn", SHARE, check=_check),
    knob_fault("board.late", FaultKind.DELAYED, "frames of both boards come late", "late_s",
               Number("s", 0.0, 1.0, default=0.05), check=_check),
    knob_fault("board.rows", FaultKind.WRONG,
               "both boards send this number of rows: another profile", "rows",
               Number("rows", 1, 64, default=16, whole=True), check=_check),
    _of_finger("uskin.off", FaultKind.UNPLUGGED, "this finger's board is unplugged", "silent"),
    _of_finger("uskin.low_supply", FaultKind.REBOOT,
               "this finger's board restarts at low supply and waits for its start",
               "low_supply"),
    _of_finger("uskin.doubled", FaultKind.WRONG,
               "another board has the address of this finger's board", "doubled"),
    knob_fault("uskin.drift", FaultKind.WRONG, "z of all taxels drifts", "drift_counts_s",
               Number("counts/s", -1e5, 1e5, default=1000.0), check=_check_uskin),
)
# fmt: on
