"""Sorting: named parts at their places, rejects, and what ends a sort."""

from collections.abc import Callable
from typing import Any

import pytest

from cell.config.file import changed_config
from cell.control.part import Part
from cell.control.positioner import Destination
from cell.control.states import CellState
from cell.errors import CellStopped, ConfigError, NoPartFound
from cell.learning.taught_model import TaughtModel
from cell.runtime.goals import SortGoal
from cell.runtime.sort import Places, SortAnswer, simulated_feed
from cell.runtime.tasks import ModelFile, Tasks
from cell.runtime.worker import Report
from recognition.recognizer import UNKNOWN
from tests.cell.conftest import MakeBench

BINS = [{"label": "ball", "place": "bin 1"}, {"label": "box", "place": "bin 2"}]
STRANGE = {"label": "rod", "shape": "cylinder:diameter=6mm,length=20mm"}


class Sorter:
    """A cell that sorts, and what its host saw at each place."""

    def __init__(self, make_bench: MakeBench, taught: Any, **changes: Any) -> None:
        objects = [entry.model_dump() for entry in taught.config.simulator.objects]
        config = changed_config(
            taught.config, {"sort.places": BINS, "simulator.objects": [*objects, STRANGE]} | changes
        )
        self.seen: list[tuple[str, str | None, float]] = []
        self.on_place: Callable[[Destination], Any] = lambda _destination: None
        self.bench = make_bench(config, places=self._places)
        self.controller = self.bench.controller
        self.controller.start()
        self.model = TaughtModel.load(config, taught.result.model)
        self.tasks = Tasks(self.controller, ModelFile(self.model, None))
        self.parts: list[Part] = []
        self.tasks.parts.listeners.append(lambda part, _found: self.parts.append(part))
        self.progress: dict[str, Any] = {}

    def sort(self, *feed: str) -> None:
        goal = SortGoal(parts=len(feed), feed=feed, seed=7)
        self.tasks.sort(goal, Report(1, lambda **now: self.progress.update(now["progress"])))

    def _places(self, destination: Destination) -> Any:
        placed = self.bench.simulated.devices.world.placed
        held = None if placed is None else placed[0]
        self.seen.append((destination.place, held, self.bench.grip_n))
        return self.on_place(destination)


@pytest.fixture
def sorter(make_bench: MakeBench, taught: Any) -> Sorter:
    return Sorter(make_bench, taught)


@pytest.mark.slow
def test_each_part_is_held_until_it_is_at_its_place(sorter: Sorter) -> None:
    sorter.sort("ball", "box", "rod")
    assert [(place, held) for place, held, _ in sorter.seen] == [
        ("bin 1", "ball"),
        ("bin 2", "box"),
        ("reject", "rod"),
    ]
    assert min(force_n for _, _, force_n in sorter.seen) > 3.0
    assert (sorter.controller.life.state, sorter.bench.grip_n) == (CellState.IDLE, 0.0)
    tally = sorter.progress
    assert tally["places"] == {"bin 1": 1, "bin 2": 1, "reject": 1}
    assert (tally["share_named"], tally["mistakes"]) == (pytest.approx(2 / 3), [])
    assert tally["matrix"]["rod"] == {"bin 1": 0, "bin 2": 0, "reject": 1}
    found = [(part.number, part.label, part.job, part.task) for part in sorter.parts]
    assert found == [(1, "ball", 1, "sort"), (2, "box", 1, "sort"), (3, UNKNOWN, 1, "sort")]


def test_a_part_in_another_bin_is_a_mistake_and_a_reject_is_none(taught: Any) -> None:
    config = changed_config(taught.config, {"sort.places": BINS})
    tally = SortAnswer(targets=Places(config, ("ball", "box")))
    for number, (truth, place) in enumerate(
        [("ball", "bin 1"), ("ball", "bin 2"), ("box", "reject"), ("", "bin 1")]
    ):
        tally.add(Part(number=number, presented=truth, place=place))
    assert tally.mistakes == [{"number": 1, "was": "ball", "place": "bin 2"}]
    assert tally.n_rejected == 1
    assert tally.matrix() == {
        "ball": {"bin 1": 1, "bin 2": 1, "reject": 0},
        "box": {"bin 1": 0, "bin 2": 0, "reject": 1},
    }


@pytest.mark.slow
def test_a_part_that_changed_in_the_grip_goes_to_the_rejects(sorter: Sorter) -> None:
    def shove(destination: Destination) -> None:
        if destination.place != "reject":
            sorter.bench.simulated.devices.world.slide(2.5e-3)

    sorter.on_place = shove
    sorter.sort("ball")
    assert [place for place, *_ in sorter.seen] == ["bin 1", "reject"]
    (part,) = sorter.parts
    assert (part.label, part.place) == ("ball", "reject")
    assert any("footprint" in reason for reason in part.changed)
    assert sorter.progress["mistakes"] == []


@pytest.mark.slow
def test_a_stop_just_before_a_part_is_let_go_keeps_it(sorter: Sorter) -> None:
    verify = sorter.controller.kept_part.verify

    def then_cancel() -> Any:
        check = verify()
        sorter.controller.life.cancel()
        return check

    sorter.on_place = lambda _destination: True  # is an answer too: the part is there
    sorter.controller.kept_part.verify = then_cancel
    with pytest.raises(CellStopped, match="before it was let go"):
        sorter.sort("ball", "box")
    assert sorter.controller.life.state is CellState.COMPLETE
    assert sorter.bench.grip_n > 3.0


@pytest.mark.slow
def test_turns_without_a_part_are_counted_and_three_in_a_row_end_the_sort(
    make_bench: MakeBench, taught: Any
) -> None:
    changes = {"sequence.x_mm": [0.0, 0.0]}
    sorter = Sorter(make_bench, taught, **changes)
    positioner = sorter.controller.moves.positioner
    gone = {0, 2, 3, 4}
    turns: list[int] = []

    class Feed:
        """Takes the part away again in some turns."""

        blocks = False

        def __getattr__(self, name: str) -> Any:
            return getattr(positioner, name)

        def present(self, label: str | None, *_supervise: Any) -> None:
            turns.append(len(turns))
            positioner.present(label)

        def move_to(self, pose: Any, *_supervise: Any) -> Any:
            reached = positioner.move_to(pose)
            if turns[-1] in gone:
                sorter.bench.simulated.remove()
            return reached

    sorter.controller.moves.positioner = Feed()
    with pytest.raises(NoPartFound):
        sorter.sort(*["ball"] * 8)
    assert len(turns) == 5
    assert (sorter.progress["n_missed"], sorter.progress["places"]["bin 1"]) == (4, 1)


def test_places_are_checked_before_anything_is_sorted(taught: Any) -> None:
    with pytest.raises(ConfigError, match=r"no place for box: add a place for each"):
        Places(changed_config(taught.config, {"sort.places": BINS[:1]}), ("ball", "box"))
    with pytest.raises(ConfigError, match=r"sort\.places repeat"):
        changed_config(taught.config, {"sort.places": [BINS[0], BINS[0]]})
    places = Places(taught.config, ("ball", "box"))
    assert places.names == ("ball", "box", "reject")
    assert places.of(UNKNOWN).place == "reject"


def test_poses_of_places_reach_the_positioner(taught: Any) -> None:
    entry = {"label": "ball", "place": "left", "pose": {"x_mm": 120.0, "rotation_deg": 90.0}}
    config = changed_config(taught.config, {"sort.places": [entry, BINS[1]]})
    pose = Places(config, ("ball", "box")).of("ball").pose
    assert (pose.x_m, pose.rotation_rad) == pytest.approx((0.12, 1.5708), abs=1e-4)


def test_the_simulated_feed_has_each_kind_as_often(taught: Any) -> None:
    feed = simulated_feed(taught.config, 20)
    assert {label: feed.count(label) for label in feed} == {"ball": 10, "box": 10}
    assert feed != sorted(feed)
    assert feed == simulated_feed(taught.config, 20)
