"""What a cell tells its recording, where it makes one."""

from collections.abc import Sequence

from cell.grasp_states import GraspState
from cell.hand import HandStatistics
from cell.identification import Identification
from cell.loop_values import loop_values
from cell.pose import Pose
from cell.recording import Recorder
from cell.states import CellState
from gripper.state import Cycle
from recognition.grasp import Grasp
from tactile.protocol import TactileFrame


class Journal:
    """Passes on to a recorder what happens; without one, nothing.

    Parameters
    ----------
    recorder
        The recording; None makes none.
    """

    def __init__(self, recorder: Recorder | None) -> None:
        self._recorder = recorder
        self._states: tuple[CellState, GraspState] | None = None

    def note(self, kind: str, text: str) -> None:
        """Record that something happened."""
        if self._recorder is not None:
            self._recorder.event(kind, text)

    def states(self, state: CellState, grasp: GraspState) -> None:
        """Record both states where one of them has changed."""
        now = (state, grasp)
        if self._recorder is not None and now != self._states:
            self._recorder.state(*now)
        self._states = now

    def cycle(self, cycle: Cycle, frames: Sequence[TactileFrame] = ()) -> None:
        """Record one period of the loop and the frames that came in it.

        Raises
        ------
        RecordingError
            If the recording has stopped and the config wants the cell to hold then.
        """
        if self._recorder is not None:
            self._recorder.cycle(cycle)
            for frame in frames:
                self._recorder.frame(frame)
            if self._recorder.vital and self._recorder.fault is not None:
                raise self._recorder.fault

    def pose(self, pose: Pose) -> None:
        """Record the pose that was reached."""
        if self._recorder is not None:
            self._recorder.pose(pose)

    def grasp(self, grasp: Grasp) -> None:
        """Record that the newest frames make up this grasp."""
        if self._recorder is not None:
            self._recorder.grasp(grasp)

    def loop(self, statistics: HandStatistics) -> None:
        """Record how punctual the force loop was so far."""
        if self._recorder is not None:
            self._recorder.loop(loop_values(statistics.loop, undelivered=statistics.undelivered))

    def result(self, found: Identification) -> None:
        """Record the answer of a sequence, and what went wrong in whoever was told of it."""
        for text in found.complaints:
            self.note("callback", text)
        if self._recorder is not None:
            self._recorder.result(
                label=found.label,
                probability=found.probability,
                labels=found.fused.labels,
                probabilities=[float(p) for p in found.fused.probability],
                unknown=found.fused.unknown,
                n_grasps=len(found.records),
                n_ended_early=sum(record.early is not None for record in found.records),
                shape=found.shape,
                grasp_shapes=found.shapes,
                drift=found.drift,
            )
