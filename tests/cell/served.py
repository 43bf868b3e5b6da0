"""Services with interfaces, on a stub and a virtual clock, and plugins on simulated cells."""

import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.config.model import CellConfig
from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle, LatchedFault
from cell.control.live import LiveValues
from cell.control.part import Part, Verification
from cell.control.plan import Pose
from cell.control.states import CellState, Command, command_effect
from cell.errors import CellStateError, CellStopped, RequestRefused
from cell.fault_catalogue import error_text, fault_number
from cell.interfaces.access import ACCEPTED_AT_ONCE
from cell.interfaces.opening import open_interfaces
from cell.runtime.goals import TASKS, Goal, GripGoal, IdentifyGoal, TeachGoal, VerifyGoal
from cell.runtime.parts import OnPart
from cell.runtime.plugin import HostStatus, TactileCellPlugin
from cell.runtime.worker import Job, JobOutcome
from cell.service.service import Service, open_service
from gripper.values.state import GripperPhase
from recognition.recognizer import UNKNOWN
from tests.cell.conftest import quick_config, small_config
from tests.fuzz.harness import Clock
from tests.values import make_shape
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
        service = Service(StubPlugin(config.serve.objects), config, note=note, clock=clock)
    else:
        service = open_service(config, clock=clock, **cell)
    with closing(service):
        served = Served(service, clock)
        with open_interfaces(service) if interfaces else nullcontext({}) as served.interfaces:
            yield served


@pytest.fixture
def serve(request: pytest.FixtureRequest, undo: ExitStack) -> Callable[..., Served]:
    """Return the maker of services; ``interfaces`` opens them.

    Each stands on a stub, or with ``cell``, options of the plugin, on a simulated cell that was
    taught.
    """

    def make(*interfaces: str, cell: dict[str, Any] | None = None, **more: Any) -> Served:
        if cell is not None:
            cell = {"model": request.getfixturevalue("taught").result.model} | cell
        return undo.enter_context(serving(*interfaces, cell=cell, **more))

    return make


@pytest.fixture
def tls(tmp_path: Path) -> dict[str, str]:
    """Options of a service that name a certificate of 127.0.0.1 and its key."""
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "cert.pem")
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "2", "-subj", "/CN=cell", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", key, "-out", certificate],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("openssl is not there to make a certificate")
    return {"serve__tls_certificate": certificate, "serve__tls_key": key}


@pytest.fixture
def make_plugin(undo: ExitStack) -> Callable[..., Any]:
    """Return the maker of plugins on simulated cells: small ones with a model, else quick ones."""

    def make(config: CellConfig | None = None, **options: Any) -> Any:
        usual = small_config(**BRISK) if options.get("model") else quick_config()
        plugin = TactileCellPlugin(config or usual, **options)
        undo.callback(plugin.close, LIMIT_S)
        return plugin

    return make


@pytest.fixture
def plugin(make_plugin: Any, taught: Any) -> Any:
    """A plugin that knows ball and box."""
    return make_plugin(model=taught.result.model)


def done(plugin: Any, goal: Any) -> Any:
    """Run a job of a plugin to its end and return what it gives."""
    return plugin.result(plugin.start(goal), LIMIT_S)


def grip_n(plugin: Any) -> float:
    return min(plugin.cell.simulated.world.contact_force_n())


# -- A stub of `TactileCellPlugin`: the table of states, without devices, time and threads ---------


GRIP_N = 3.25
"""Force of the stub on a part, in N."""
ROUND = make_shape("sphere", 9.5, half_mm=0.5, dimensions_m={"diameter": 9.5e-3})
"""Shape of each part."""
FLAT = {"shape": "flat", "size_mm": 2.0}
"""Shape of an object that is taught."""
CURVES = {
    "t_s": [0.0, 1.0, 2.0], "force_n": [0.0, 1.0, 7.6], "setpoint_n": [0.0, 1.0, 7.5],
    "opening_mm": [18.0, 9.5, 9.4], "frame": [0.1] * 408,
}  # fmt: skip
"""Last grasp of each part."""
GRASP = SimpleNamespace(
    cycles=(SimpleNamespace(setpoint_n=5.0),), outcome=SimpleNamespace(final_force_n=4.9)
)
"""Record of each grasp."""
VERIFIED = Verification(held=True, same=True, force_n=GRIP_N, opening_m=9.5e-3)
"""Answer of each grip and verify."""


class StubPlugin:
    """A cell that does as it is asked."""

    def __init__(self, listed: tuple[str, ...] = ()) -> None:
        self.listed = listed
        self.objects: dict[str, dict[str, Any]] = {
            label: {"n_grasps": 5, "shape": "sphere", "size_mm": 9.5} for label in ("ball", "box")
        }
        """The taught objects by label."""
        self.taught_revision = 0
        self.finds = ""
        """What the next part is named; as it is presented where it is empty."""
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
        self._jobs: list[Job] = []
        self._end: tuple[CellState, bool, Any] = (CellState.IDLE, False, None)
        self._paused = self._closed = False
        self._last_answer: Part | None = None
        self._part_numbers = count(1)
        self._hand: Any = SimpleNamespace()
        self._life = CellLifecycle(self._hand, Journal(None), Clock(), 0.6)
        self.cell = SimpleNamespace(controller=SimpleNamespace(life=self._life))
        self.recording_path: Path | None = None
        self.working = True
        self._show(CellState.IDLE, holding=False)

    # -- what tests do -------------------------------------------------------------------------

    def pause(self) -> None:
        """Have the next job run until `go_on` or `fail`."""
        self._paused = True

    def report(self, **progress: Any) -> None:
        """Have the job that runs report so much more."""
        self._set(progress=self.job().progress | progress)

    def report_part(self, part: Part) -> None:
        """Have the job that runs report a part."""
        self._set(part=part)

    def ready(self) -> None:
        """Be idle with empty fingers, whatever was before; the job that runs is cancelled."""
        self._life.latched = None
        self._over(JobOutcome.CANCELED, CellState.IDLE, holding=False)

    def go_on(self) -> None:
        """Let the job that runs, if any, succeed."""
        if (job := self._running) is not None:
            state, holding, value = self._end
            if isinstance(value, Part):
                now = {"job": job.number, "number": next(self._part_numbers), "seconds": 9.4}
                known = {"label_id": self.label_id(value.label), "time_s": time.time()}
                value = self._last_answer = value.model_copy(update=now | known)
                self.on_part(value, SimpleNamespace(records=[GRASP]))
                self._set(part=value)
            elif isinstance(value, Verification):
                self._set(verification=value)
            if isinstance(self._goal, TeachGoal):
                taught = self.objects.setdefault(self._goal.label, {"n_grasps": 0, **FLAT})
                taught["n_grasps"] += self._goal.grasps
                self.taught_revision += 1
            self._over(JobOutcome.SUCCEEDED, state, holding=holding, value=value)

    def fail(self, error: Exception) -> None:
        """Have a fault: the job that runs ends with it, and the grip is kept."""
        self._life.latched = LatchedFault(error_text(error), fault_number(error), since_s=1.0e9)
        self._over(JobOutcome.ABORTED, CellState.ABORTED, error=error_text(error), exception=error)

    def show(self, **values: Any) -> None:
        """Have these values of `HostStatus` until the next change of state."""
        self._status = replace(self._status, **values)

    # -- what the service asks -----------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        return {"name": "stub", "simulated": True, "n_taxels": 408, "labels": self.labels_by_id}

    def status(self) -> HostStatus:
        return self._status

    def watch_parts(self, on_part: OnPart) -> None:
        self.on_part = on_part

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(self.objects)

    @property
    def labels_by_id(self) -> tuple[str, ...]:
        return (*self.listed, *(label for label in self.objects if label not in self.listed))

    def label_id(self, label: str) -> int:
        labels = self.labels_by_id
        return labels.index(label) + 1 if label in labels else 0

    def taught(self) -> list[dict[str, Any]]:
        return [
            {"label": label, "label_id": self.label_id(label)} | values
            for label, values in self.objects.items()
        ]

    def forget(self, label: str, *, last: bool) -> Job:
        self.taught_revision += 1
        self.objects[label]["n_grasps"] -= 1
        if not last:
            del self.objects[label]
        return self._accept(("forget", last), Command.GRASP, CellState.EXECUTE, self._end)

    def forget_drift(self) -> Job:
        state = self._life.state
        return self._accept(("forget_drift", False), None, state, (state, False, None))

    def health(self) -> dict[str, Any]:
        return self.levels

    def check(self, task: str) -> None:
        goal = task in TASKS
        command = {"grip": Command.GRIP, "verify": Command.VERIFY}.get(task, Command.GRASP)
        self._check(command if goal else self._needed(Command(task)))

    def job(self, number: int | None = None) -> Job:
        if number is None:
            return self._jobs[-1] if self._jobs else Job()
        if not 1 <= number <= len(self._jobs):
            raise RequestRefused(f"there is no job {number}; the newest is {len(self._jobs)}")
        return self._jobs[number - 1]

    def jobs(self) -> tuple[Job, ...]:
        return tuple(self._jobs)

    @property
    def _running(self) -> Job | None:
        return None if not self._jobs or self._jobs[-1].terminal else self._jobs[-1]

    def _set(self, **fields: Any) -> None:
        self._jobs[-1] = self._jobs[-1].model_copy(update=fields)

    def remark(self, kind: str, text: str) -> None:
        self.remarks.append((kind, text))

    def start(self, goal: Goal) -> Job:
        command, value, keeps = Command.GRASP, None, False
        if isinstance(goal, IdentifyGoal):
            label, keeps = self.finds or goal.present or "ball", goal.keep != "never"
            probabilities = {UNKNOWN: 0.1, label: 0.9}
            value = Part(
                label=label, probabilities=probabilities, n_grasps=1, in_grip=keeps, shape=ROUND
            )
        elif isinstance(goal, GripGoal | VerifyGoal):
            command, value, keeps = Command(goal.task), VERIFIED, True
        end = CellState.COMPLETE if keeps else CellState.IDLE
        return self._accept(goal, command, CellState.EXECUTE, (end, keeps, value))

    def start_command(
        self, command: Command, *, reboot: bool = False, needless: bool = False
    ) -> Job:
        state, holding = self._life.state, self._status.holding
        needed: Command | None = self._needed(command)
        path = command_effect(state, needed).path or (state,)
        if needless and not command_effect(state, needed).accepted:
            needed = None
        end = CellState.IDLE if command is Command.RESET else path[-1]
        keeps = holding and command is not Command.RELEASE
        return self._accept((command, reboot), needed, path[0], (end, keeps, None))

    _needed = TactileCellPlugin._needed

    def _check(self, needed: Command | None) -> None:
        if self._closed:
            raise CellStateError("the cell is closed")
        if self._running is not None:
            raise CellStateError(f"job {self._running.number} is not over")
        if needed is not None:
            self._life.check(needed)

    def cancel(self, job: Job, reason: str) -> None:
        if (running := self._running) is not None and job.number == running.number:
            stop = CellStopped(f"stopped {reason}")
            self._over(JobOutcome.CANCELED, CellState.HELD, error=str(stop), exception=stop)

    def close(self, _timeout_s: float) -> None:
        self._closed = True

    def _accept(
        self,
        asked: Goal | tuple[str, bool],
        needed: Command | None,
        acting: CellState,
        end: tuple[CellState, bool, Any],
    ) -> Job:
        self._check(needed)
        self._goal = asked
        if isinstance(asked, IdentifyGoal):
            self._last_answer = None
        if needed is Command.CLEAR:
            self._life.latched = None
        self._end = end
        task = asked.task if hasattr(asked, "task") else str(asked[0])
        number = len(self._jobs) + 1
        self._jobs.append(
            Job(number=number, task=task, outcome=JobOutcome.EXECUTING, since_s=time.time())
        )
        self._show(acting, holding=self._status.holding or acting is CellState.EXECUTE)
        if not self._paused:
            self.go_on()
        self._paused = False
        # At last: a test in another thread goes on as soon as it is there.
        self.asked.append(asked)
        return self.job(number)

    def _over(
        self, outcome: JobOutcome, state: CellState, *, holding: bool | None = None, **end: Any
    ) -> None:
        self._show(state, holding=self._status.holding if holding is None else holding)
        if self._running is not None:
            self._set(outcome=outcome, **end)

    def _show(self, state: CellState, *, holding: bool) -> None:
        """Set the states in one assignment: interfaces read them in threads of their own."""
        self._life.state = state
        self._hand.phase = GripperPhase.HOLDING if holding else GripperPhase.IDLE
        live = LiveValues(
            force_n=GRIP_N if holding else 0.0,
            force_age_s=0.005,
            setpoint_n=GRIP_N if holding else 0.0,
            opening_mm=9.5 if holding else 40.0,
            temperature_c=31.0,
            counts=np.full(408, len(self._jobs), dtype=np.uint16),
            frame_age_s=0.02,
        )
        if state in (CellState.ABORTED, CellState.STOPPED):
            live = LiveValues()
        status = asdict(self._life.status)
        self._status = HostStatus(**status, live=live, last_answer=self._last_answer)
