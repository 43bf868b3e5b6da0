"""Whole cells in virtual time, for tests: with a controller, or with the plugin of a host."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from cell.build import Cell, Mover, build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.config.sequence import SequenceConfig
from cell.control.controller import CellController
from cell.control.identification import Identification
from cell.control.plan import GraspStep, Pose, plan
from cell.control.positioner import CarryCallback
from cell.control.records import GraspRecord
from cell.errors import CellStateError
from cell.learning.shape_reading import shape_reader
from cell.learning.training import train
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.tasks import Collection
from pytest_tactile_cell.process import AskedCell
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from simulator.cell import SimulatedCell
from simulator.clock import VirtualClock
from simulator.faults.vocabulary import Fault


@dataclass(frozen=True, kw_only=True)
class VirtualCell:
    """A simulated cell in virtual time: time passes only during waits."""

    config: CellConfig
    """Its config."""
    cell: Cell
    """Controller and both links, from `cell.build.build_cell` as for every cell."""
    simulated: SimulatedCell
    """The simulated devices, with true values that only a simulator has."""

    @classmethod
    def of(
        cls,
        config: CellConfig,
        *,
        mover: Mover | None = None,
        places: CarryCallback | None = None,
        folder: Path | None = None,
    ) -> Self:
        """Build the cell of a config with simulated ports; arguments as `build_cell`."""
        if mover is not None:
            config = changed_config(config, {"positioner": {"kind": "callback"}})
        cell = build_cell(config, mover=mover, places=places, folder=folder)
        if cell.simulated is None:
            raise AssertionError("a config with simulated ports gave a cell with real ones")
        return cls(config=config, cell=cell, simulated=cell.simulated)

    def end(self) -> None:
        """Close the cell."""
        self.cell.close()

    @property
    def controller(self) -> CellController:
        """The controller, which runs the sequences."""
        return self.cell.controller

    @property
    def clock(self) -> VirtualClock:
        """The clock of all parts of this cell."""
        return self.simulated.clock

    @property
    def grip_n(self) -> float:
        """True force in N on the pad with less force; 0 while nothing is held."""
        return min(self.simulated.world.contact_force_n())

    @property
    def aperture_m(self) -> float:
        """True opening between the pads in m."""
        return self.simulated.devices.mechanics.aperture_m

    def inject(self, text: str) -> Fault:
        """Inject a fault such as ``can.loss=0.05@2s``; tests use `inject_fault`, which clears it.

        Raises
        ------
        simulator.errors.SimulatorSettingsError
            If the fault does not exist or does not fit; the message has a hint.
        """
        return self.simulated.inject(text)

    def start(self, present: str | None = None) -> "VirtualCell":
        """Start the cell, and bring an object if one is named; returns the cell.

        Raises
        ------
        cell.errors.CellError, gripper.errors.GripperError, tactile.errors.TactileError
            As `CellController.start`.
        """
        self.controller.start()
        if present is not None:
            self.controller.moves.present(present)
        return self

    def sleep(self, seconds: float) -> None:
        """Advance the virtual time by s without the controller; no real time passes."""
        self.clock.sleep(seconds)

    def idle(self, seconds: float) -> None:
        """Advance the time by s as between two jobs: with links alive and supervised.

        Raises
        ------
        gripper.errors.GripperError, tactile.errors.TactileError
            A fault that the controller detects.
        """
        if not seconds >= 0.0:
            raise ValueError(f"idle takes a time of at least 0 s, got {seconds}")
        due_s = self.clock.monotonic()
        end_s = due_s + seconds
        while due_s < end_s:
            due_s = max(due_s + self.controller.hand.period_s, self.clock.monotonic())
            self.clock.advance_to(due_s)
            self.controller.life.tick()

    def grasp(self, force_n: float = 3.0, pose: Pose | None = None) -> GraspRecord:
        """Run one grasp up to a force in N; see `CellController.grasp` for what it raises."""
        return self.controller.grasp(GraspStep(pose=pose or Pose(), force_n=force_n))

    def teach(self, labels: Sequence[str], grasps: int = 6, *, seed: int = 0) -> Recognizer:
        """Grasp each object several times and train the config's recognizer.

        Raises
        ------
        cell.errors.CellError
            If there are too few grasps for training, or as `CellController.grasp`.
        """
        settings = self.config.recognition
        return train(
            grasps_of(self.controller, self.config.sequence, labels, grasps, seed=seed),
            settings.recognizer,
            use_aperture=settings.use_aperture,
        ).recognizer

    def identify(
        self, recognizer: Recognizer, present: str, *, seed: int = 1, early: bool = False
    ) -> Identification:
        """Bring an object and identify it; only the simulator uses the name ``present``.

        With ``early`` ramps end when the answer is sure enough.
        """
        self.controller.moves.present(present)
        sequence = self.config.sequence
        return self.controller.identify(
            recognizer,
            plan(sequence, sequence.max_grasps, seed=seed),
            early=early,
            read_shape=shape_reader(self.config),
        )


class CellRuntime(TactileCellPlugin, AskedCell):
    """A `TactileCellPlugin` on simulated devices that takes the faults of a test."""

    @property
    def running(self) -> bool:
        """Whether it takes requests: false after `close`."""
        return not self._closed

    end = TactileCellPlugin.close

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request to the simulated devices, for example ``state=True``; return the reply.

        Raises as `simulate`.
        """
        if self._closed:
            raise CellStateError("the cell is closed; load the plugin again")
        return self.simulate(request)


def grasps_of(
    controller: CellController,
    sequence: SequenceConfig,
    labels: Sequence[str],
    n_grasps: int,
    *,
    seed: int = 0,
) -> list[Grasp]:
    """Grasp each known object ``n_grasps`` times and return the grasps; see `Collection.fill`.

    The plan of each object has its own seed, starting at ``seed``.
    """
    grasps: list[Grasp] = []
    for number, label in enumerate(labels):
        collection = Collection(label=label, n_planned=n_grasps)
        collection.fill(controller, sequence, seed=seed + number)
        grasps += collection.grasps
    return grasps
