"""A cell in virtual time for the campaign, a job with a fault, and what the cell did about it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.fault_campaign.invariants import InvariantMonitor
from benchmarks.fault_campaign.row import Observed
from cell.build import Cell, build_cell
from cell.config import CellConfig
from cell.config_changes import changed_config
from cell.controller import CellController
from cell.errors import CellError
from cell.pose import Pose
from cell.sequence import GraspStep
from cell.states import CellState
from gripper.errors import GripperError
from simulator.assembly import SimulatedCell
from tactile.errors import TactileError

COARSE_PADS = {
    "name": "coarse",
    "adc_max": 255,
    "pads": [
        {"finger": finger, "face": "inner", "rows": 6, "columns": 3}
        | {"pitch_x_mm": 5.0, "pitch_y_mm": 5.0}
        for finger in (0, 1)
    ],
}
"""One pad of 6 x 3 taxels on each finger: frames of six messages."""
JOB_BOUND_S = 60.0
"""Every command has to be over within so many s of simulated time."""
PRODUCT_ERRORS = (CellError, GripperError, TactileError)


def campaign_config(**changes: Any) -> CellConfig:
    """Return a config with short jobs; changes as ``tactile__layout=COARSE_PADS``."""
    short_jobs = {
        "gripper.aperture_open_mm": 16.0,
        "tactile.tare_frames": 10,
        "sequence.ramp": {"kind": "linear", "rate_n_s": 10.0, "hold_s": 0.3},
        "simulator.objects": [
            {"label": "ball", "shape": "sphere:diameter=9.5mm"},
            {"label": "box", "shape": "box:length=15.9mm,width=10mm,height=10mm"},
        ],
        "simulator.noise_level": 0.5,
    }
    wanted = {path.replace("__", "."): value for path, value in changes.items()}
    return changed_config(CellConfig(), short_jobs | wanted)


def machine_config(*, self_test: bool) -> CellConfig:
    """Return a config whose commands take little time: coarse pads, a slow loop, short ways."""
    return campaign_config(
        tactile__layout=COARSE_PADS,
        gripper__loop_rate_hz=100.0,
        gripper__aperture_open_mm=12.0,
        gripper__approach_speed_mm_s=20.0,
        gripper__watchdog_self_test=self_test,
        gripper__contact_timeout_s=2.0,
        sequence__ramp={"kind": "linear", "rate_n_s": 20.0, "hold_s": 0.05},
        sequence__max_grasps=2,
    )


@dataclass(kw_only=True)
class CampaignCell:
    """A simulated cell, its controller, and who watches both.

    Attributes
    ----------
    cell
        Controller, links, recording.
    monitor
        The invariants.
    """

    cell: Cell
    monitor: InvariantMonitor

    @property
    def controller(self) -> CellController:
        """The product."""
        return self.cell.controller

    @property
    def simulated(self) -> SimulatedCell:
        """The hardware."""
        if self.cell.simulated is None:
            raise RuntimeError("the campaign runs on simulated cells")
        return self.cell.simulated

    @property
    def now_s(self) -> float:
        """Simulated time in s."""
        return self.simulated.clock.monotonic()

    @property
    def grip_n(self) -> float:
        """True force in N on the pad that carries less."""
        return min(self.simulated.world.contact_force_n())

    def start(self) -> None:
        """Start the cell and bring the object."""
        self.controller.start()
        self.controller.present("ball")

    def grasp(self, force_n: float = 3.0) -> Any:
        """Run one grasp at the pads' centre."""
        return self.controller.grasp(GraspStep(pose=Pose(), force_n=force_n))

    def idle(self, seconds: float) -> None:
        """Let time pass while the cell supervises its links."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.simulated.clock.sleep(self.controller.hand.period_s)
            self.controller.tick()


@contextmanager
def campaign_cell(*, folder: Path | None = None, **changes: Any) -> Iterator[CampaignCell]:
    """Give a cell that is not started yet; at the end its invariants are checked.

    Raises
    ------
    InvariantBroken
        If the cell did what none may ever do.
    """
    config = campaign_config(**changes)
    cell = build_cell(config, folder=folder)
    assert cell.simulated is not None
    monitor = InvariantMonitor(cell.simulated, config.gripper)
    monitor.attach(cell)
    try:
        yield CampaignCell(cell=cell, monitor=monitor)
    finally:
        monitor.close()
        cell.close()
    monitor.check()


def grasp_job(cell: CampaignCell) -> None:
    """Start, bring the object, and grasp it with 3 N."""
    cell.start()
    cell.grasp()


def observe(
    cell: CampaignCell,
    fault: str | Callable[[], Any],
    job: Callable[[CampaignCell], Any] = grasp_job,
) -> Observed:
    """Inject a fault, run a job, and say what became of both.

    Parameters
    ----------
    cell
        A cell that is not started, or one that is made ready for the job.
    fault
        Text of the vocabulary, or a function that brings it about at once.
    job
        What the cell shall do meanwhile.
    """
    monitor = cell.monitor
    injected = cell.simulated.inject(fault) if isinstance(fault, str) else None
    if callable(fault):
        fault()
    began_s = cell.now_s
    monitor.watch_from()
    error: BaseException | None = None
    try:
        with monitor.bounded(JOB_BOUND_S):
            job(cell)
    except PRODUCT_ERRORS as caught:
        error = caught
    known_s = cell.now_s if monitor.latched_s is None else monitor.latched_s
    if injected is not None:
        if injected.began_s is None:
            raise RuntimeError(f"{injected.text} has not begun when the job was over")
        began_s = injected.began_s
    grip = _grip(cell)
    if error is not None:
        return Observed(
            reaction=_reaction(cell),
            detected_after_s=max(0.0, known_s - began_s),
            outcome=f"{_short(f'{type(error).__name__}: {error}')}; {grip}",
        )
    if monitor.noted_s is not None:
        return Observed(
            reaction="NOTE",
            detected_after_s=max(0.0, monitor.noted_s - began_s),
            outcome=f"counted; the job was done; {grip}",
        )
    return Observed(reaction="NOTHING", detected_after_s=None, outcome=f"the job was done; {grip}")


def _reaction(cell: CampaignCell) -> str:
    """Name what an error has done: refused a start, kept the grip, or found it gone."""
    if not cell.monitor.states & {CellState.IDLE, CellState.EXECUTE, CellState.HELD}:
        return "REJECT"
    servos = [servo.core for servo in cell.simulated.devices.servo_bus.servos]
    if any(servo.latched or servo.silent_until_s > 0.0 for servo in servos):
        return "ABORT"
    return "HOLD" if all(servo.torque_on for servo in servos) else "LIMP"


def _grip(cell: CampaignCell) -> str:
    controller = cell.controller
    held = "the grip is kept" if controller.holding else "nothing is held"
    return f"{controller.state.value}, {held} ({cell.grip_n:.1f} N)"


def _short(text: str) -> str:
    return text if len(text) <= 160 else text[:157] + "..."
