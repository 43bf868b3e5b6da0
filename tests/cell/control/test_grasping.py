"""One grasp without a cell: fingers that close before a frame comes, and servos that bear less."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from cell.control.controller import CellController
from cell.control.grasping import Grasper
from cell.control.plan import GraspStep, Pose
from cell.errors import NoPartFound
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from tactile.layout import paper_layout
from tests.cell.conftest import small_config
from tests.fuzz.harness import Clock


@pytest.fixture
def grasper() -> Grasper:
    """A grasper whose hand finds nothing, and whose sensor sends no frame."""
    released: list[Callable[..., Any]] = []
    hand: Any = SimpleNamespace(
        layout=paper_layout(),
        period_s=0.005,
        phase=GripperPhase.IDLE,
        largest_ramp_n=12.0,
        check_ramp=lambda _ramp: None,
        open=lambda _watch: None,
        grasp=lambda _ramp, _watch: SimpleNamespace(result=GraspResult.NO_CONTACT),
        release=released.append,
        released=released,
    )
    positioner: Any = SimpleNamespace(blocks=False, move_to=lambda pose, *_: pose)
    return CellController(small_config(), hand, positioner, clock=Clock())._grasper


def test_fingers_that_close_before_a_frame_comes_open_again(grasper: Grasper) -> None:
    with pytest.raises(NoPartFound, match="had closed before a frame of the taxels came"):
        grasper.grasp(GraspStep(pose=Pose(), force_n=3.0), "")
    assert len(grasper.hand.released) == 1  # type: ignore[attr-defined]
    assert grasper.life.result is GraspResult.NO_CONTACT


def test_servos_that_carry_less_than_asked_for_end_the_ramp_there_with_one_note(
    grasper: Grasper, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand: Any = grasper.hand
    finals_n, notes = [], []
    monkeypatch.setattr(grasper.journal, "note", lambda _kind, text: notes.append(text))

    def grasp(ramp: ForceRamp, _watch: object) -> Any:
        finals_n.append(ramp.final_n)
        return SimpleNamespace(result=GraspResult.NO_CONTACT)

    hand.grasp, hand.largest_ramp_n = grasp, 4.0
    for force_n in (3.0, 6.0, 6.0):
        with pytest.raises(NoPartFound):
            grasper.grasp(GraspStep(pose=Pose(), force_n=force_n), "")
    assert finals_n == pytest.approx([3.0, 3.6, 3.6])
    (note,) = notes
    assert "grasps end at 3.6 N, 6.0 N were asked for" in note
    assert "current_max_a" in note
    # What the config itself does not allow is refused as ever.
    hand.check_ramp = lambda ramp: finals_n.append(ramp.final_n)
    grasper.check(GraspStep(pose=Pose(), force_n=40.0))
    assert finals_n[-1] == 40.0
