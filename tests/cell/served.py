"""Services with interfaces, on a stub and a virtual clock, and plugins on simulated cells."""

import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.controller import CellController
from cell.control.part import Part, Verification
from cell.control.plan import Pose
from cell.control.states import CellState, Command, Event
from cell.hand.interface import LatestValues
from cell.interfaces.access import ACCEPTED_AT_ONCE
from cell.interfaces.opening import open_interfaces
from cell.runtime.goals import Goal, GripGoal, IdentifyGoal, TeachGoal, VerifyGoal
from cell.runtime.plugin import HostStatus, TactileCellPlugin
from cell.runtime.tasks import Tasks
from cell.runtime.worker import Job, Report
from cell.service.service import Service, open_service
from gripper.values.force_sensor import ForceSample
from gripper.values.state import GripperPhase
from recognition.recognizer import UNKNOWN
from tactile.source import TactileFrame
from tests.cell.cells import small_config
from tests.fuzz.harness import Clock
from tests.values import HAND_STATISTICS, make_cycle, make_shape, make_state
from tests.waiting import LIMIT_S, until

BRISK = {
    "gripper__aperture_open_mm": 12.0,
    "sequence__force_n": [2.0, 4.0],
    "recognition__recognizer": "level_check",
    "recognition__shape": False,
}
"""Short ways and ramps, and a quick training, for plugins that need not name an object."""
LEASE_S = 60.0
"""Time-out of leases: only the clock of the test lets it pass."""


def pause(number: int) -> None:
    """Let the interface accept the connections before each 15th one.

    A connection that finds no room in the queue waits for a second.
    """
    if number % (ACCEPTED_AT_ONCE - 1) == 0:
        threading.Event().wait(0.02)


def ended(link: socket.socket) -> bool:
    """Send one more byte of a request; whether the interface has closed the connection."""
    try:
        link.sendall(b"x")
        link.setblocking(False)
        return link.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@dataclass
class Served:
    """A service and its interfaces, on a stub or on a plugin with a simulated cell."""

    service: Service
    clock: Clock
    interfaces: dict[str, Any] = field(default_factory=dict)

    @property
    def plugin(self) -> Any:
        return self.service.plugin

    @property
    def grip_n(self) -> float:
        """Force on the pad that carries less."""
        if isinstance(self.plugin, StubPlugin):
            return GRIP_N if self.plugin.status().holding else 0.0
        return grip_n(self.plugin)

    @property
    def state(self) -> str:
        return self.plugin.status().state

    def ended(self, number: int | None = None) -> Job:
        """Wait for the end of a job and return it."""
        return until(lambda: (job := self.plugin.job(number)).outcome_number >= 4 and job)

    def pass_lease(self) -> None:
        """Let the time of the lease pass."""
        self.clock.now_s += LEASE_S + 1.0
        self.service.lease.has(0)

    def ask_pose(self, pose: Pose) -> Future[Pose | bool]:
        """Wait for the host at a pose, as the thread of a cell does; return what it answers."""
        thread = ThreadPoolExecutor(1)
        answer = thread.submit(self.service._poses.move, pose)
        thread.shutdown(wait=False)
        until(lambda: self.service.snapshot().pose)
        return answer


@contextmanager
def serving(
    *interfaces: str, cell: dict[str, Any] | None = None, note: Any = print, **changes: Any
) -> Iterator[Served]:
    """Open a service as `serve` does; ``changes`` are those of the config."""
    ports = {f"serve__{name}_port": None for name in ("modbus", "xmlrpc", "http")}
    ports |= {f"serve__{name}_port": 0 for name in interfaces}
    config = small_config(**{"serve__lease_timeout_s": LEASE_S, **ports, **changes})
    clock = Clock()
    if cell is None:
        service = Service(StubPlugin(config), config, note=note, clock=clock)
    else:
        service = open_service(config, clock=clock, **cell)
    with closing(service):
        served = Served(service, clock)
        with open_interfaces(service) if interfaces else nullcontext({}) as served.interfaces:
            yield served


def done(plugin: Any, goal: Any) -> Any:
    """Run a job of a plugin to its end and return what it gives."""
    return plugin.result(plugin.start(goal), LIMIT_S)


def grip_n(plugin: Any) -> float:
    return min(plugin.cell.simulated.world.contact_force_n())


# -- A stub of the plugin: the product without devices, grasps and a trained model -----------------


GRIP_N = 3.25
"""Force of the stub on a part, in N."""
ROUND = make_shape("sphere", 9.5, half_mm=0.5, dimensions_m={"diameter": 9.5e-3})
"""Shape of each part."""
CURVES = {
    "t_s": [0.0, 1.0, 2.0], "force_n": [0.0, 1.0, 7.6], "setpoint_n": [0.0, 1.0, 7.5],
    "opening_mm": [18.0, 9.5, 9.4], "frame": [0.1] * 408,
}  # fmt: skip
"""Last grasp of each part."""
GRASP = SimpleNamespace(
    cycles=(SimpleNamespace(setpoint_n=5.0),),
    outcome=SimpleNamespace(final_force_n=4.9, unreached=""),
)
"""Record of each grasp."""
VERIFIED = Verification(held=True, same=True, force_n=GRIP_N, opening_m=9.5e-3)
"""Answer of each grip and verify."""


class StubTasks(Tasks):
    """Tasks that move nothing: each grasp ends at once, or when the test lets it."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.going, self.acting = threading.Event(), threading.Event()
        self.going.set()
        self.error: Exception | None = None
        """What ends the grasp that is let go on."""
        self.finds = ""
        """What the next part is named; as it is presented where it is empty."""

    def act(self, *, keeps: bool = False, event: Event = Event.EXECUTE) -> None:
        """Have a part in the grip, until a stop or the test, and after it where it is kept."""
        controller = self.controller
        with controller.life.executing(event):
            hold(controller.hand, True)
            self.acting.set()
            assert self.going.wait(LIMIT_S)
            controller.life.check_cancelled()
            if self.error is not None:
                raise self.error
            hold(controller.hand, keeps)
            if keeps:
                controller.life.keep(since="grip")
            else:
                controller.life.complete()

    def named(self, goal: IdentifyGoal, _on_grasp: Any = None) -> tuple[Any, str]:
        label, keeps = self.finds or goal.present or "ball", goal.keep != "never"
        self.act(keeps=keeps)
        fused = SimpleNamespace(probabilities={UNKNOWN: 0.1, label: 0.9})
        values = {"label": label, "in_grip": keeps, "fused": fused, "records": [GRASP]}
        return SimpleNamespace(**values, n_ended_early=0, shape=ROUND, drift=None), ""

    def grip(self, _goal: GripGoal, _report: Report) -> Verification:
        self.act(keeps=True)
        return VERIFIED

    def verify(self, _goal: VerifyGoal, _report: Report) -> Verification:
        self.act(keeps=True, event=Event.VERIFY)
        return VERIFIED

    def teach(self, goal: TeachGoal, _report: Report) -> None:
        self.act()
        new = {"n_grasps": 0, "shape": "flat", "size_mm": 2.0}
        self.model.taught.setdefault(goal.label, new)["n_grasps"] += goal.grasps
        self.model.revision += 1

    def gauge(self, _goal: Any, _report: Report) -> None:
        self.act()

    zero = gauge


class StubModel(Mock):
    """What is taught, as the page lists it; the model allows each task."""

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(self.taught)

    def objects(self) -> dict[str, Any]:
        return self.taught

    def forget(self, label: str, *, last: bool) -> None:
        self.revision += 1
        self.taught[label]["n_grasps"] -= 1
        if not last:
            del self.taught[label]


def hold(hand: Any, held: bool) -> None:
    """Give a hand the values of a part in its grip, or of open fingers."""
    hand.phase = GripperPhase.HOLDING if held else GripperPhase.IDLE
    hand.n_frames += 1
    counts = np.full(hand.layout.n_taxels, hand.n_frames, dtype=np.uint16)
    state = make_state(aperture_m=9.5e-3 if held else 0.04)
    force_n = GRIP_N if held else 0.0
    hand.latest = LatestValues(
        cycle=make_cycle(0.0, state=state, setpoint_n=force_n),
        force=ForceSample(t_s=-0.005, force_n=(force_n, force_n)),
        frame=TactileFrame(t_s=-0.02, counter=hand.n_frames, status=0, counts=counts),
    )


def stub_cell(config: CellConfig) -> SimpleNamespace:
    """Return a cell whose hand grasps nothing; its time stands still."""
    hand = Mock(layout=layout_from_config(config.tactile), period_s=0.005, own_process=False)
    hand.configure_mock(statistics=HAND_STATISTICS, n_frames=0, notes=())
    hand.start.return_value.rows = ()
    hand.shutdown.return_value = ""
    hand.release.side_effect = lambda *_watch: hold(hand, False)
    hold(hand, False)
    controller = CellController(config, hand, Mock(), clock=Clock())
    controller.zeros, controller.zeroing = Mock(), Mock()
    controller.moves, controller.kept_part = Mock(), Mock()
    controller.kept_part.verify.return_value = VERIFIED
    return SimpleNamespace(
        controller=controller,
        realtime=False,
        simulated=None,
        idle=controller.life.tick,
        recording_path=None,
        recording_fault=None,
        close=lambda: None,
    )


class StubPlugin(TactileCellPlugin):
    """The plugin of a cell that does as it is asked."""

    working = True

    def __init__(self, config: CellConfig) -> None:
        taught = {
            label: {"n_grasps": 5, "shape": "sphere", "size_mm": 9.5} for label in ("ball", "box")
        }
        model = StubModel(config=config, taught=taught, revision=0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("cell.build.build_cell", lambda *_config, **_options: stub_cell(config))
            patch.setattr("cell.learning.taught_model.TaughtModel", lambda *_: model)
            patch.setattr("cell.runtime.tasks.Tasks", StubTasks)
            super().__init__(config)
        self.cell.controller.hand.request_stop.side_effect = self._tasks.going.set
        self.newtons = SimpleNamespace(
            of=lambda counts: counts.astype(np.float32), curves=lambda _record: CURVES
        )
        self.levels: dict[str, Any] = {
            "servos": {"level": "ok", "temperature_c": [41.0, 40.0], "load": [0.18, 0.2]}
        }
        """Health."""
        self.asked: list[Goal | tuple[str, bool]] = []
        """What was accepted: goals, and commands with their ``reboot``."""
        self.remarks: list[tuple[str, str]] = []
        self._shown: dict[str, Any] = {}

    # -- what tests do -------------------------------------------------------------------------

    def pause(self) -> None:
        """Have the next task run until `go_on` or `fail`."""
        self._tasks.going.clear()
        self._tasks.acting.clear()

    def go_on(self) -> None:
        """Let the task that runs succeed."""
        self._tasks.going.set()
        self._worker.wait(self.job(), LIMIT_S)

    def fail(self, error: Exception) -> None:
        """Have a fault: the task that runs ends with it, and the grip is kept."""
        if self._worker.running:
            self._tasks.error = error
            self.go_on()
            self._tasks.error = None
        else:
            with suppress(type(error)), self.cell.controller.life.latching_faults():
                raise error

    def ready(self) -> None:
        """Be idle with empty fingers, whatever was before; the job that runs is cancelled."""
        if self._worker.running:
            self.cancel(self.job())
        life = self.cell.controller.life
        life.latched, life.state = None, CellState.IDLE
        hold(life.hand, False)

    def report(self, part: Part | None = None, **progress: Any) -> None:
        """Have the job that runs report so much more."""
        job = self.job()
        self._worker._set(job.number, progress=job.progress | progress, part=part or job.part)

    def show(self, **values: Any) -> None:
        """Have these values of `HostStatus` from now on."""
        self._shown |= values

    def find(self, part: Part) -> None:
        """Have a part without grasps."""
        for listener in self._parts.listeners:
            listener(part, None)

    # -- what differs: jobs end before they are returned, unless one is paused -----------------

    def status(self) -> HostStatus:
        return replace(super().status(), **self._shown)

    def taught(self) -> list[dict[str, Any]]:
        return [
            {"label": label, "label_id": self._parts.label_id(label)} | values
            for label, values in self.model.taught.items()
        ]

    def health(self) -> dict[str, Any]:
        return self.levels

    def remark(self, kind: str, text: str) -> None:
        self.remarks.append((kind, text))

    def start(self, goal: Goal) -> Job:
        job = super().start(goal)
        if not self._tasks.going.is_set():
            assert self._tasks.acting.wait(LIMIT_S)
        return self._ended(job, goal)

    def start_command(self, command: Command, **options: bool) -> Job:
        job = super().start_command(command, **options)
        return self._ended(job, (command, options["reboot"]))

    def forget(self, label: str, *, last: bool) -> Job:
        return self._ended(super().forget(label, last=last), ("forget", last))

    def _ended(self, job: Job, asked: Goal | tuple[str, bool]) -> Job:
        if self._tasks.going.is_set():
            self._worker.wait(job, LIMIT_S)
        self.asked.append(asked)
        return self.feedback(job)

    def cancel(self, job: Job, reason: str = "on request") -> None:
        super().cancel(job, reason)
        self._worker.wait(job, LIMIT_S)
