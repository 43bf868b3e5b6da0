"""Collection of the grasps of one known object, which train a recogniser."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from cell.config.sequence import SequenceConfig
from cell.control.controller import CellController
from cell.control.plan import plan
from cell.control.records import GraspRecord
from cell.errors import NoPartFound
from cell.learning.blas import one_blas_thread
from recognition.grasp import Grasp

MISSES_IN_A_ROW = 3
"""Grasps in a row without a part after which a known object counts as absent."""


@dataclass(slots=True, kw_only=True)
class Collection:
    """Grasps of one known object so far."""

    label: str
    """Name of the object."""
    n_planned: int
    """Number of planned grasps."""
    present: str | None = None
    """Object to place if its name differs from the label (simulated cell)."""
    records: list[GraspRecord] = field(default_factory=list)
    """Grasps that held the object, in order."""
    n_missed: int = 0
    """Number of grasps without a part; they are not in the records."""

    @property
    def grasps(self) -> list[Grasp]:
        """The recorded grasps."""
        return [record.grasp for record in self.records]

    @property
    def short(self) -> str:
        """Number of ramps that ended below their force, and why the last one did; or empty."""
        texts = [record.outcome.short for record in self.records if record.outcome.short]
        return f"{len(texts)} of {self.n_planned} ramps ended early: {texts[-1]}" if texts else ""

    def __str__(self) -> str:
        missed = f" ({self.n_missed} found no part)" if self.n_missed else ""
        return f"{len(self.records)} of {self.n_planned} grasps of {self.label}{missed}"

    @one_blas_thread()
    def fill(
        self,
        controller: CellController,
        sequence: SequenceConfig,
        *,
        seed: int,
        on_grasp: Callable[["Collection"], None],
    ) -> None:
        """Grasp the object at different poses and forces until the plan ends.

        A grasp that finds no part is only counted. After an error the earlier grasps stay in the
        records. ``on_grasp`` is called with this collection after each grasp, also a missed one.
        Raises NoPartFound if several grasps in a row, or all grasps, find no part. Raises
        cell.errors.CellStopped, gripper.errors.GripperError or tactile.errors.TactileError as
        `CellController.grasp`.
        """
        steps = plan(sequence, self.n_planned, seed=seed)
        controller.check_plan(steps, self.label)
        controller.moves.present(self.present or self.label)
        missed, in_a_row = None, 0
        for step in steps:
            try:
                self.records.append(controller.grasp(step, label=self.label))
                in_a_row = 0
            except NoPartFound as error:
                missed, in_a_row = error, in_a_row + 1
                if in_a_row == MISSES_IN_A_ROW:
                    raise
                self.n_missed += 1
            on_grasp(self)
        if missed is not None and not self.records:
            raise missed


def grasps_of(
    controller: CellController,
    sequence: SequenceConfig,
    labels: Sequence[str],
    n_grasps: int,
    *,
    seed: int = 0,
    on_grasp: Callable[[Collection], None] = lambda _now: None,
) -> list[Grasp]:
    """Grasp each known object ``n_grasps`` times and return the grasps; see `Collection.fill`.

    The plan of each object has its own seed, starting at ``seed``.
    """
    grasps: list[Grasp] = []
    for number, label in enumerate(labels):
        one = Collection(label=label, n_planned=n_grasps)
        one.fill(controller, sequence, seed=seed + number, on_grasp=on_grasp)
        grasps += one.grasps
    return grasps
