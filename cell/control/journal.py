"""The journal of a cell: it writes events and values into the recording, if there is one."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from cell.control.identification import Identification
from cell.control.plan import Pose
from cell.control.states import CellState, GraspState
from cell.hand.interface import HandStatistics
from cell.recording import schema
from cell.recording.recorder import Recorder
from cell.recording.schema import estimate_values, shape_values
from gripper.force.timing import LoopStatistics
from gripper.values.state import Cycle
from recognition.grasp import Grasp
from tactile.source import TactileFrame


def counters(statistics: HandStatistics) -> dict[str, dict[str, Any]]:
    """Return the counts and times of the force loop, the tactile sensor and the servo bus."""
    source = asdict(statistics.source)
    frames, forces = source.pop("frames"), source.pop("forces")
    del source["recent_loss_rate"]
    forces = {f"force_{name}": count for name, count in forces.items()}
    return {
        "loop": asdict(statistics.loop) | {"undelivered": statistics.undelivered},
        "tactile": frames | source | forces | asdict(statistics.sensor),
        "servo_bus": asdict(statistics.servo_bus),
    }


def loop_line(statistics: LoopStatistics, period_s: float) -> str:
    """Return whether the force loop was on time, as one line for people."""
    if not statistics.cycles:
        return "Force loop: no figures."
    late, missed = statistics.late + statistics.overruns, statistics.missed_reads
    if not late and not missed:
        return "Force loop: on time."
    return (
        f"Force loop: of {statistics.cycles:,} periods of {period_s * 1e3:g} ms {late} were late, "
        f"by up to {statistics.lateness.max_s * 1e3:.1f} ms, {missed} without an answer of the "
        "servos."
    )


class Journal:
    """Writes events, states, periods, grasps and answers to a recorder, if there is one."""

    def __init__(self, recorder: Recorder | None) -> None:
        self._recorder = recorder
        self._states: tuple[CellState, GraspState] | None = None
        self.brought: str | None = None
        """Label of the object that the positioner brought; None if it has no name."""

    def _now(self, topic: str, values: Mapping[str, Any]) -> None:
        if self._recorder is not None:
            self._recorder.now(topic, values)

    def begin(self) -> None:
        """Continue a recording that has stopped or is long; call between two grasps."""
        if self._recorder is not None and self._recorder.begin():
            self._states = None

    def note(self, kind: str, text: str, fault_number: int = 0) -> None:
        """Record an event; a fault with its number."""
        number = {"fault_number": fault_number} if fault_number else {}
        self._now(schema.EVENT, {"kind": kind, "text": text} | number)

    def states(self, state: CellState, grasp: GraspState) -> None:
        """Record both states, with both clocks, if one of them has changed."""
        now = (state, grasp)
        if self._recorder is not None and now != self._states:
            values = {
                "state": state.value,
                "state_number": state.number,
                "grasp": grasp.value,
                "grasp_number": grasp.number,
                "wall_ns": time.time_ns(),
            }
            self._now(schema.STATE, values)
        self._states = now

    def cycle(self, cycle: Cycle, frames: Sequence[TactileFrame] = ()) -> None:
        """Record one period of the loop and the frames that came in it."""
        if self._recorder is not None:
            self._recorder.cycle(cycle)
            for frame in frames:
                self._recorder.frame(frame)

    def check(self) -> None:
        """Raise RecordingError if the recording has stopped and the config makes this a fault."""
        if self._recorder is not None and self._recorder.vital and self._recorder.fault is not None:
            raise self._recorder.fault

    def pose(self, pose: Pose) -> None:
        """Record the pose that was reached."""
        self._now(schema.POSE, asdict(pose))

    def grasp(self, grasp: Grasp) -> None:
        """Record that the newest frames belong to this grasp."""
        if self._recorder is not None:
            self._recorder.grasp(grasp)

    def loop(self, statistics: HandStatistics) -> None:
        """Record the timing of the force loop so far, and the counts of both links."""
        links = counters(statistics)
        self._now(schema.LOOP, links.pop("loop") | links)

    def result(self, answer: Identification) -> None:
        """Record the answer of a sequence and its complaints."""
        for text in answer.complaints:
            self.note("callback", text)
        values: dict[str, Any] = {
            "label": answer.label,
            "probability": answer.decision.probability,
            "labels": list(answer.fused.labels),
            "probabilities": answer.fused.probability.tolist(),
            "unknown": float(answer.fused.unknown),
            "n_grasps": len(answer.records),
            "n_ended_early": answer.n_ended_early,
            "grasp_answers": [
                {
                    "probabilities": posterior.probability.tolist(),
                    "unknown": float(posterior.unknown),
                    "dependence": float(posterior.dependence),
                }
                for posterior in answer.posteriors
            ],
        }
        if self.brought:
            values["held"] = self.brought
        if answer.shape is not None:
            values["shape"] = shape_values(answer.shape)
        if answer.shapes:
            values["grasp_shapes"] = [shape_values(shape) for shape in answer.shapes]
        if answer.drift is not None:
            values |= estimate_values(answer.drift)
        self._now(schema.RESULT, values)
