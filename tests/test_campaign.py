"""The campaign: it goes on where it was, tries again what broke, and counts."""

import json
from pathlib import Path

import pytest

from tests import campaign
from tests.campaign import GOAL, MACHINE, Campaign, load_properties
from tests.faults.state_machine import Outcome
from tests.fuzz import harness
from tests.fuzz.harness import Piece

GOALS = {"one": 100, "other": 50}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "out" / "campaign.json"


def test_the_parsers_that_guard_the_grip_and_the_machine_have_a_million() -> None:
    goals = load_properties()
    assert goals[MACHINE] == GOAL
    for module in ("test_servo_bytes", "test_can_messages", "test_slcan_lines"):
        wanted = [goal for name, goal in goals.items() if name.startswith(module)]
        assert len(wanted) >= 2
        assert set(wanted) == {GOAL}
    assert len(goals) == 1 + len(campaign.WIRES) + len(harness.PROPERTIES)
    assert set(campaign.WIRES.values()) == {"modbus", "xmlrpc", "http"}


def test_pieces_are_taken_from_what_is_least_far_until_all_is_done(path: Path) -> None:
    made = Campaign(path, GOALS)
    taken = []
    while (piece := made.take()) is not None:
        taken.append(piece)
        made.done[piece[0]].add(piece[1], Piece(outcomes={"so": 25}), 1.0, again=False)
    assert taken == [("one", 0), ("other", 0), ("one", 1), ("other", 1), ("one", 2), ("one", 3)]


def test_a_campaign_goes_on_where_it_was(path: Path) -> None:
    first = Campaign(path, GOALS)
    pieces = [first.take() for _ in range(4)]
    assert pieces == [("one", 0), ("other", 0), ("one", 1), ("other", 1)]
    first.done["one"].add(1, Piece(outcomes={"so": 20}), 1.5, again=False)
    first.done["other"].add(
        0, Piece(outcomes={"so": 10, "not": 5}, failures=["x"]), 1.0, again=False
    )
    first.save([("one", 0), ("other", 1)])
    then = Campaign(path, GOALS)
    assert then.done["one"].inputs == 20
    assert then.broken() == [("other", 0)]
    assert [then.take() for _ in range(3)] == [("one", 0), ("other", 1), ("one", 2)]
    assert "other: 15 of 50 (so 10; not 5); BROKEN in 1 pieces" in then.table()
    assert then.complaints() == ["other, piece 0: x", "one: the same became of all inputs"]
    then.done["other"].add(0, Piece(outcomes={"so": 15}), 1.0, again=True)
    assert then.done["other"].inputs == 15
    assert not then.broken()


def test_what_broke_is_tried_again_first_and_counted_once(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one process, so that what breaks can be said."""
    tried: list[tuple[str, int]] = []
    broken = {3}

    def run_machine(steps: int, seed: int, *, door: str) -> Outcome:
        assert not door
        number = seed - campaign.FIRST_MACHINE_SEED
        tried.append((MACHINE, number))
        defect = "let go" if number in broken else ""
        return Outcome(steps=steps, seconds=0.0, defect=defect)

    class Here:
        """A pool of no processes."""

        def __init__(self, *_: object, **__: object) -> None: ...

        def __enter__(self) -> "Here":
            return self

        def __exit__(self, *_: object) -> None: ...

        def submit(self, act, *arguments):
            future = campaign.Future()
            future.set_result(act(*arguments))
            return future

    monkeypatch.setattr(campaign, "run_machine", run_machine)
    monkeypatch.setattr(campaign, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(campaign, "GOAL", 10_000)
    arguments = ["--only", MACHINE, "--jobs", "2", "--progress", str(path)]
    with pytest.raises(SystemExit, match=r"piece 3: let go"):
        campaign.main(arguments)
    assert [number for _, number in tried] == [0, 1, 2, 3, 4, 5]
    broken.clear()
    tried.clear()
    campaign.main(arguments)
    assert tried == [(MACHINE, 3)]
    assert f"{MACHINE}: 12,000 of 10,000 (steps 12,000)\n" in capsys.readouterr().out
    assert json.loads(path.read_text())[MACHINE]["failures"] == {}


def test_no_property_of_that_name_is_wrong_use(path: Path) -> None:
    with pytest.raises(SystemExit, match="2"):
        campaign.main(["--only", "nothing like it", "--progress", str(path)])


def test_pieces_are_run_in_processes_until_time_or_inputs_are_over(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign, "GOAL", 2 * harness.SEEDED_PIECE)
    arguments = ["--only", "test_an_emergency", "--jobs", "1", "--progress", str(path)]
    campaign.main([*arguments, "--seconds", "0"])
    assert not path.exists()
    campaign.main(arguments)
    ((done,),) = [json.loads(path.read_text()).values()]
    assert done["inputs"] == campaign.GOAL
    assert done["next_piece"] == 2
