"""The lifecycle without a cell: what an error leaves where the grip or a clear fails as well."""

from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest

from cell.control import lifecycle
from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle, LatchedFault
from cell.control.states import CellState
from cell.errors import PositionerError
from gripper.errors import BusTimeout, ServoFault
from gripper.values.state import GripperPhase
from tests.fuzz.harness import Clock
from tests.values import raising


def life_of(state: CellState, phase: GripperPhase, **hand: Any) -> CellLifecycle:
    return CellLifecycle(
        SimpleNamespace(phase=phase, **hand),  # type: ignore[arg-type]
        Journal(None),
        Clock(),
        0.2,
        state=state,
    )


@pytest.mark.parametrize(
    ("phase", "state", "kept"),
    [(GripperPhase.IDLE, CellState.IDLE, []), (GripperPhase.HOLDING, CellState.ABORTED, ["kept"])],
)
def test_a_pose_that_is_not_reached_is_a_fault_beside_a_part_alone(phase, state, kept) -> None:
    calls: list[str] = []
    life = life_of(CellState.EXECUTE, phase, keep_grip=lambda: calls.append("kept"))
    with pytest.raises(PositionerError), life.latching_faults():
        raise PositionerError("the arm stands")
    assert (life.state, calls, life.faults.total()) == (state, kept, len(kept))


def test_a_grip_that_cannot_be_confirmed_does_not_hide_the_fault() -> None:
    unplugged = raising(BusTimeout("the cable is out"))
    life = life_of(CellState.EXECUTE, GripperPhase.RAMPING, keep_grip=unplugged)
    with pytest.raises(ServoFault), life.latching_faults():
        raise ServoFault(1, 0x20, "overload")
    assert (life.state, life.status.fault_number) == (CellState.ABORTED, 109)


def test_a_clear_that_fails_keeps_the_first_fault_or_names_it_beside_that_of_a_servo() -> None:
    life = life_of(CellState.ABORTED, GripperPhase.HELD_AFTER_FAULT)
    life.latched = LatchedFault("no frame for 0.2 s", 401)
    for error, number in ((BusTimeout("the cable is out"), 401), (ServoFault(1, 32, "hot"), 109)):
        life.hand.clear_fault = raising(error)  # type: ignore[method-assign]
        with pytest.raises(type(error)):
            life.clear(reboot=False)
        assert (life.state, life.status.fault_number) == (CellState.ABORTED, number)
    assert str(life.fault).endswith("(first: no frame for 0.2 s)")


@pytest.mark.parametrize("way", ["fault", "clear that fails", "clear"])
def test_text_number_and_time_of_a_fault_are_one_value_for_other_threads(way, monkeypatch) -> None:
    seen: list[tuple[bool, bool, bool]] = []

    def reading(name: str) -> Any:
        real = getattr(lifecycle, name)

        def read(*given: Any) -> Any:
            now = life.status
            seen.append((now.fault is None, now.fault_number == 0, now.fault_since_s is None))
            return real(*given)

        return read

    latched = way != "fault"
    life = life_of(
        CellState.ABORTED if latched else CellState.EXECUTE,
        GripperPhase.HELD_AFTER_FAULT,
        keep_grip=lambda: None,
        clear_fault=(lambda **_: None) if way == "clear" else raising(ServoFault(1, 32, "hot")),
    )
    if latched:
        life.latched = LatchedFault("no frame for 0.2 s", 401)
    for name in ("error_text", "fault_number", "next_state"):
        monkeypatch.setattr(lifecycle, name, reading(name))
    with suppress(ServoFault):
        if latched:
            life.clear()
        else:
            with life.latching_faults():
                raise ServoFault(1, 32, "hot")
    assert len(seen) >= 2
    assert all(len(set(one)) == 1 for one in seen), seen
    assert life.faults.total() == life.status.n_faults
