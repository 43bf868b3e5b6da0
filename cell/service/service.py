"""The service: one cell for many clients; one client at a time may command.

Every call returns at once: each motion is a job with a number, whose state can be read. A client
commands under a lease that it renews. `stop` needs no lease: anyone may call it, once or while a
button is pressed. If the lease is lost while a job runs, the job is stopped: the grip is kept, and
nothing resumes by itself.
"""

import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from math import inf
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from cell.config.model import CellConfig
from cell.config.simulator import checked_label
from cell.control.answer import Answer, Verification
from cell.control.identification import Identification
from cell.control.plan import Pose
from cell.control.states import Command
from cell.errors import CellError, HeldByClient, RequestRefused, raised_as
from cell.fault_catalogue import error_text
from cell.runtime.goals import (
    TASKS,
    Goal,
    GripGoal,
    IdentifyGoal,
    SortGoal,
    checked_goal,
    goal_of,
)
from cell.runtime.host_status import HostStatus
from cell.runtime.lease import Lease
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import KEPT_JOBS, Job, JobOutcome, JobStatus
from cell.service.history import History
from cell.service.photos import Photos
from cell.service.pose_handshake import PoseHandshake
from cell.service.shift import KEPT_ANSWERS, Shift
from cell.service.totals import Totals
from cell.simulation import shape_of_stl
from gripper.clock import Clock

RELEASE_KEY = 0x4F50
"""Key of a release ("OP"): zeroed or repeated outputs of a controller never release a part."""
_STOPS_MAX = 100
"""Most clients that keep the cell stopped; more are refused, but the cell stops."""
_UNMOVING = (Command.CLEAR.value, Command.SHUTDOWN.value)
"""Commands without motion, allowed while a client keeps the cell stopped."""
_KEEPING = (*_UNMOVING, Command.RESET.value, "verify", "forget", "forget_drift")
"""Tasks and commands that leave the part in the grip."""
_COMMANDS = (Command.RELEASE, Command.CLEAR, Command.RESET, Command.SHUTDOWN)
"""Commands of clients."""
_HEALTH_S = 0.5
"""Time in s for which a computed health of the cell is reused."""
OUTCOME_NUMBERS = {
    JobOutcome.ACCEPTED: 1,
    JobOutcome.EXECUTING: 2,
    JobOutcome.SUCCEEDED: 4,
    JobOutcome.CANCELED: 5,
    JobOutcome.ABORTED: 6,
}
"""Number of each outcome for hosts: GoalStatus of ROS 2 actions; 0 is no job."""


class RequestFields(TypedDict, total=False):
    """Fields of tasks and commands of hosts with plain numbers; see `Service.request`."""

    label: str
    grasps: int
    max_grasps: int
    force_n: float
    keep: bool | str
    parts: int
    present: str
    key: int
    reboot: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class JobView:
    """A job in the form that every interface shows."""

    number: int = 0
    task: str = ""
    """Its number, 0 before the first job, and its task or command."""
    since_s: float = 0.0
    """Unix time in s of its start."""
    outcome: str = ""
    outcome_number: int = 0
    """Its state."""
    fault_number: int = 0
    error: str = ""
    """Why it failed; else 0 and empty."""
    label: str = ""
    label_id: int = 0
    probability: float = 0.0
    n_grasps: int = 0
    """Answer of an identification; before its end the answer so far, with label id 0. For a sort
    the answer of its newest part."""
    shape: str = ""
    size_mm: float = 0.0
    """Shape of the part and its size in mm; empty and 0 if not known."""
    kept: bool = False
    """Whether the answer leaves the part in the grip."""
    held: bool | None = None
    same: bool | None = None
    """Answer of a verification."""
    taught: Mapping[str, Any] | None = None
    """Answer of a teaching: label, its available grasps, the nearest other object, and the share of
    grasps that are more similar to another object."""
    gauged: Mapping[str, Any] | None = None
    """Answer of a gauge: label, and the drift ``before`` and ``after`` it: ``gain``,
    ``opening_mm``."""
    progress: Mapping[str, Any] = field(default_factory=dict)
    """Last report of the job."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """Everything that an interface shows, at one moment."""

    status: HostStatus
    """States, live values, last answer."""
    job: JobView
    """The newest job."""
    last_answer: JobView | None
    """The job of the last answer of an identification, as `HostStatus.last_answer`."""
    commander: str
    """Name of the client with the lease; empty for none."""
    held_by: tuple[str, ...]
    """Clients that keep the cell on hold; "(gone)" follows the name of a disconnected client."""
    part: Answer | None
    """The newest part of an identification or sort; None before the first."""
    held_part: int | None
    """Number of the part in the grip; None if nothing is held or the part has no name."""
    pose_seq: int
    pose: Pose | None
    """The pose that the host shall reach and its number; 0 and None without a pending pose."""


@dataclass(slots=True)
class _Stop:
    """A client that keeps the cell stopped; its time is inf while it is connected."""

    name: str
    heard_s: float


class Service:
    """One cell, its lease, its jobs and its pose handshake; every method from any thread.

    `cell.service.opening.open_service` opens a cell with its service.

    Parameters
    ----------
    plugin
        The cell, without ``host_timeout_s``: the lease supervises the clients. It is closed with
        the service.
    poses
        Mover of a cell with a positioner of kind ``callback``.
    history_file
        SQLite file of the history; None keeps it in memory.
    photos_beside
        Model file; the photos of taught objects are beside it. None keeps them in memory.
    note
        Gets messages for the operator.
    clock
        Time of the clients: real time even if the cell's time is virtual.
    wall_s
        Returns the unix time in s, for shift and history.
    """

    def __init__(
        self,
        plugin: TactileCellPlugin,
        config: CellConfig,
        *,
        poses: PoseHandshake | None = None,
        history_file: Path | None = None,
        photos_beside: Path | None = None,
        note: Callable[[str], None] = lambda _text: None,
        clock: Clock = time,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        self.config = config
        self.version = version("tactile-cell")
        self.boot = int(time.time()) % 0xFFFF + 1
        """Number of this start, 1 to 65535, from the seconds of its time: it differs at each start.
        """
        self.shift = Shift(config.serve.shift_begins_h, lambda: plugin.status().n_faults, wall_s)
        """The ledger of the parts."""
        self.totals = Totals()
        """Growing totals, for metrics."""
        self.history = History(
            history_file, plugin.status, note=note, shift=self.shift, wall_s=wall_s
        )
        """Parts and faults of the days."""
        self.history.start()
        plugin.watch_parts(self._count)
        self.photos = Photos(photos_beside)
        """Photos of taught objects."""
        self.plugin = plugin
        """The cell, for what it alone knows; its jobs are started by the service."""
        self._poses = PoseHandshake() if poses is None else poses
        self._clock = clock
        self._lock = threading.RLock()
        self.lease = Lease(
            config.serve.lease_timeout_s,
            given=lambda name: plugin.remark("lease", f"{name!r} is in command"),
            lost=self._lose,
            clock=clock,
            lock=self._lock,
        )
        """Commands need it; its loss stops the running job."""
        self._stops: dict[Hashable, _Stop] = {}
        self._jobs: dict[int, tuple[Job, str, int, float]] = {}
        self._newest = self._gripped_by = 0
        self._health: tuple[float, dict[str, Any]] = (-inf, {})
        self._part: str | None = None
        self._n_in_turn = 0
        self._watched: dict[str, Callable[[], bool]] = {}
        self.lease.watch(note)

    # -- questions -----------------------------------------------------------------------------

    @property
    def labels(self) -> tuple[str, ...]:
        """Names by label id, from 1: ``serve.objects``, then other taught labels."""
        listed = self.config.serve.objects
        return (*listed, *(label for label in self.plugin.labels if label not in listed))

    def label_id(self, label: str) -> int:
        """Return the id of a label; 0 for UNKNOWN and for a label without an id."""
        names = self.labels
        return names.index(label) + 1 if label in names else 0

    def snapshot(self) -> Snapshot:
        """Return everything that interfaces show."""
        with self._lock:
            # Read the job before the answer: the answer is set before the job succeeds.
            job = self.job()
            status = self.status()
            seq, pose = self._poses.awaited
            last = self._answered(status)
            part = next(iter(self.shift.parts[-1:]), None)
            named = last is not None and last.kept and last.number >= self._gripped_by
            return Snapshot(
                status=status,
                job=job,
                last_answer=last,
                commander=self.lease.name,
                held_by=self.held_by,
                part=part,
                held_part=part.number if part and named and status.holding else None,
                pose_seq=seq,
                pose=pose,
            )

    def status(self) -> HostStatus:
        """Return the states of cell and grip, the live values, and the last answer."""
        return self.plugin.status()

    def job(self, number: int | None = None) -> JobView:
        """Return a job, the newest by default. Raises RequestRefused for an unknown number."""
        with self._lock:
            wanted = self._newest if number is None else number
            if wanted == 0 and number is None:
                return JobView()
            if wanted not in self._jobs:
                last = self._answered(self.status())
                if last is not None and last.number == wanted:
                    return last
                raise RequestRefused(f"there is no job {wanted}; the newest is {self._newest}")
            job, task, _, since_s = self._jobs[wanted]
            return self._view(wanted, task, self.plugin.feedback(job), since_s)

    def part(self, number: int) -> Answer:
        """Return the answer of a part by its number. Raises RequestRefused if it is not kept."""
        if (found := self.shift.part(number)) is None:
            newest = self.shift.parts[-1].number if self.shift.parts else 0
            raise RequestRefused(
                f"part {number} is not kept; the newest is {newest}, and {KEPT_ANSWERS} are kept"
            )
        return found

    def jobs(self) -> tuple[JobView, ...]:
        """Return the newest jobs, at most `KEPT_JOBS`, oldest first."""
        with self._lock:
            return tuple(self.job(number) for number in sorted(self._jobs))

    def allowed(self) -> dict[str, CellError | None]:
        """Return the error that each task and command would raise now, for a client with the lease.

        None: the task or command is allowed.
        """
        found: dict[str, CellError | None] = {}
        with self._lock:
            for task in (*TASKS, *_COMMANDS):
                try:
                    self._check_stopped(task)
                    if task != Command.CLEAR or not self._gone:
                        self.plugin.check(task)
                    found[task] = None
                except CellError as error:
                    found[task] = error
        return found

    def health(self) -> dict[str, Any]:
        """Return the values of `TactileCellPlugin.health`, at most `_HEALTH_S` old."""
        now_s = time.monotonic()
        seen_s, found = self._health
        if now_s - seen_s >= _HEALTH_S:
            found = self.plugin.health()
            self._health = (now_s, found)
        return found

    @property
    def problem(self) -> str:
        """Why the service does not work as a whole, with the next step; empty while it works."""
        for name, works in tuple(self._watched.items()):
            if not works():
                return f"{name} has ended; restart the program: it keeps the grip"
        if self.plugin.working or self._poses.awaited[1] is not None:
            return ""
        return "the thread of the cell hangs; look at the part, then restart the program"

    @contextmanager
    def watching(self, name: str, works: Callable[[], bool]) -> Iterator[None]:
        """Within the block the end of a part of the service is a `problem`."""
        self._watched[name] = works
        try:
            yield
        finally:
            del self._watched[name]

    def frame_n(self) -> NDArray[np.float32] | None:
        """Return the newest force in N on each taxel, (n_taxels,); None without a measurement."""
        counts = self.status().live.counts
        return None if counts is None else self.plugin.newtons(counts)

    def info(self) -> dict[str, Any]:
        """Return the constant values as plain data; lengths in mm, forces in N."""
        return self.plugin.info() | {
            "mode": "cell",
            "version": self.version,
            "labels": list(self.labels),
            "lease_timeout_s": self.config.serve.lease_timeout_s,
        }

    # -- commands ------------------------------------------------------------------------------

    def _lose(self, reason: str) -> None:
        self.plugin.remark("lease", f"nobody is in command, {reason}")
        self.stop(reason)

    def start(self, lease: int, goal: Mapping[str, Any], *, number: int = 0) -> int:
        """Start a job and return its number at once; see `TactileCellPlugin.start`.

        Raises NotInCommand, RequestRefused, ConfigError or CellStateError if it is refused; nothing
        has moved.

        Parameters
        ----------
        lease
            Of this client.
        goal
            ``task`` and the fields of its goal.
        number
            Number that the job shall have, to repeat a request after a lost answer. If the newest
            job has this number, it is returned, and nothing is done twice. 0: not checked.
        """
        checked, in_turn = self._with_part(checked_goal(goal))

        def begin() -> Job:
            job = self.plugin.start(checked)
            self._n_in_turn += in_turn  # a refused or repeated request takes no turn
            return job

        given = checked.model_dump(exclude_defaults=True)
        return self._begin(lease, checked.task, given, number, begin)

    def _with_part(self, goal: Goal) -> tuple[Goal, bool]:
        """Return a goal with the chosen part, or the next one, for the simulated cell.

        The second value is whether the part is the next one.
        """
        part, in_turn = self._part, False
        if not (self.config.simulated or self.config.positioner.kind == "simulated"):
            return goal, False
        if isinstance(goal, SortGoal) and not goal.feed and part is not None:
            return goal.model_copy(update={"feed": (part,)}), False
        if getattr(goal, "present", "") is not None:
            return goal, False
        if part is None and isinstance(goal, IdentifyGoal | GripGoal):
            objects, in_turn = self.config.simulator.objects, True
            part = objects[self._n_in_turn % len(objects)].label
        return goal.model_copy(update={"present": part}), in_turn

    def command(
        self, lease: int, command: Command, *, key: int = 0, reboot: bool = False, number: int = 0
    ) -> int:
        """Start a release, clear, reset or shutdown and return the number of its job.

        Parameters
        ----------
        lease, number
            As `start`.
        command, reboot
            As `TactileCellPlugin.start_command`.
        key
            `RELEASE_KEY` for a release.

        A clear also acknowledges the stops of clients that are gone.
        """

        def begin() -> Job:
            if command is Command.RELEASE and key != RELEASE_KEY:
                raise RequestRefused(f"release: {key:#x} is not the key; with it the part may fall")
            if command is not Command.CLEAR:
                return self.plugin.start_command(command, reboot=reboot)
            gone = self._gone
            job = self.plugin.start_command(command, reboot=reboot, needless=bool(gone))
            for client in gone:
                self.end_stop(client)
            return job

        given = {"reboot": True} if reboot else {}
        return self._begin(lease, command.value, given, number, begin)

    def request(
        self, lease: int, name: str, *, number: int = 0, **fields: Unpack[RequestFields]
    ) -> int:
        """Start a task or command of a host with plain numbers; return the number of its job.

        Parameters
        ----------
        lease, number
            As `start`.
        name, fields
            Of `cell.interfaces.host_calls.COMMANDS`. ``keep`` may be a bool; for fields of a task
            that are 0 or empty the config's values apply.

        Raises as `start`.
        """
        if name not in TASKS:
            key, reboot = fields.get("key", 0), fields.get("reboot", False)
            return self.command(lease, Command(name), key=key, reboot=reboot, number=number)
        if isinstance(keep := fields.get("keep"), bool):
            fields["keep"] = "always" if keep else "never"
        return self.start(lease, goal_of(name, **fields), number=number)

    def forget_drift(self, lease: int, *, number: int = 0) -> int:
        """Start to reset the followed drift and return the number of the job.

        Raises as `start`.
        """
        return self._begin(lease, "forget_drift", {}, number, self.plugin.start_forget_drift)

    # -- taught objects ------------------------------------------------------------------------

    @property
    def taught_revision(self) -> int:
        """A number that changes with the taught objects and their photos."""
        return self.plugin.taught_revision + self.photos.revision

    def taught(self) -> list[dict[str, Any]]:
        """Return `TactileCellPlugin.taught` with id and whether there is a photo."""
        return [
            one
            | {
                "label_id": self.label_id(one["label"]),
                "photo": self.photos.has(one["label"]),
            }
            for one in self.plugin.taught()
        ]

    def forget(self, lease: int, label: str, *, last: bool = False) -> int:
        """Start to forget a taught object, or its newest grasp; return the number of the job.

        Raises as `start`.
        """
        return self._begin(
            lease,
            "forget",
            {"label": label, "last": last},
            0,
            lambda: self.plugin.forget(
                label, last=last, forgotten=lambda: self.photos.remove(label)
            ),
        )

    def put_photo(self, lease: int, label: str, photo: bytes) -> None:
        """Save a photo of a taught object.

        Raises NotInCommand as `Lease.alive`, RequestRefused if the object is not taught, and as
        `Photos.put`.
        """
        self.lease.alive(lease)
        if label not in self.plugin.labels:
            raise RequestRefused(f"{label!r:.80} is not taught")
        self.photos.put(label, photo)

    # -- the simulated cell --------------------------------------------------------------------

    def simulated_faults(self) -> dict[str, Any]:
        """List the possible faults of this simulated cell, and the active faults.

        A fault is a text ``NAME[=VALUE][@START[..END]]``; a waiting fault has not begun.
        """
        injected = self.plugin.simulate({"state": True})["faults"]
        running = [
            {"fault": text, "begun": began_s is not None} for text, began_s in injected.items()
        ]
        return self.plugin.simulate({"kinds": True}) | {"running": running}

    def simulate_fault(self, text: str, *, end: bool = False) -> None:
        """Begin a fault of the simulated cell, or end those with this text or name.

        Raises RequestRefused and CellStateError as `TactileCellPlugin.simulate`.
        """
        self.plugin.simulate({"clear" if end else "inject": text})
        self.plugin.remark("simulation", f"{text} {'ended' if end else 'injected'}")

    def simulated_part(self) -> dict[str, Any]:
        """Return the chosen part and its pose, the part between the fingers, and all objects."""
        found = self.plugin.simulate({"state": True})
        pose = {name: found["offset"][name] for name in asdict(Pose())}
        return {
            "part": self._part,
            "pose": pose,
            "placed": found["placed"],
            "objects": found["objects"],
        }

    def choose_part(self, lease: int, part: str | None, pose: Pose) -> None:
        """Put a part between the fingers of the simulated cell, for all later jobs.

        Raises NotInCommand as `Lease.alive`, CellStateError while a job runs, which would grasp it
        under the name of another part, and as `TactileCellPlugin.simulate`.

        Parameters
        ----------
        part
            Name of an object, shape as text, ``nothing``; None: each job brings the next object.
        pose
            Offset from the pose that a job asks for.
        """
        self.lease.alive(lease)
        self.plugin.check_free()
        placed = self.plugin.simulate({"state": True})["placed"] if part is None else part
        self.plugin.simulate({"place": placed or "nothing", "offset": asdict(pose)})
        self._part = part
        self.plugin.remark("simulation", f"part {part or 'in turn'} at {pose}")

    def define_object(self, lease: int, label: str, stl: bytes) -> list[str]:
        """Add an object from an STL file to the simulated cell; return the names of all objects.

        Raises NotInCommand as `Lease.alive`, ConfigError if the file has no part, RequestRefused
        if the name is taken or invalid.
        """
        self.lease.alive(lease)
        with raised_as(RequestRefused, ValueError):
            shape = shape_of_stl(stl, checked_label(label))
        return list(self.plugin.simulate({"define": label, "shape": shape})["objects"])

    def reset_simulation(self, lease: int) -> int:
        """Start to make the simulated cell ready and empty; return the number of the job.

        Raises as `start`, and as `TactileCellPlugin.begin_simulation_reset`.
        """
        number = self._begin(lease, "simulation_reset", {}, 0, self.plugin.begin_simulation_reset)
        self._part = None
        return number

    def stop(self, reason: str = "on request") -> None:
        """Stop the running job and keep the grip; any client may call this."""
        with self._lock:
            entry = self._jobs.get(self._newest)
            if entry is not None and not self.plugin.feedback(entry[0]).outcome.terminal:
                self.plugin.remark("hold", reason)
                # First the cell, then the pose: the job ends as held, not as refused by the host.
                self.plugin.cancel(entry[0], reason)
                self._poses.stop()

    @property
    def held_by(self) -> tuple[str, ...]:
        """Names of the clients that keep the cell stopped; clients that are gone are marked."""
        with self._lock:
            every = self._stops.values()
            return tuple(f"{one.name} (gone)" if self._is_gone(one) else one.name for one in every)

    def stop_as(self, name: str, latch: bool | None) -> None:
        """Stop for a client without a connection: True begins, False ends, None stops once."""
        if latch is None:
            self.stop(f"by {name}")
        elif latch:
            self.begin_stop(name, name)
        else:
            self.end_stop(name)

    def begin_stop(self, client: Hashable, name: str, *, connected: bool = False) -> None:
        """Stop the running job, and allow no motion until this client ends its stop.

        A client that returns takes over the stop left by a client of the same name. ``connected``:
        the end of its connection calls `leave_stop`. Any other client counts as gone if it does not
        repeat this within ``serve.lease_timeout_s``. The cell stays stopped for a client that is
        gone until the client returns and ends the stop, or until a clear.
        Raises RequestRefused if too many clients stop the cell; the running job is stopped anyway.
        """
        with self._lock:
            for left in [k for k, one in self._stops.items() if one.name == name and k != client]:
                if self._is_gone(self._stops[left]):
                    del self._stops[left]
            if room := client in self._stops or len(self._stops) < _STOPS_MAX:
                if client not in self._stops:
                    self.plugin.remark("hold", f"begun by {name}")
                heard_s = inf if connected else self._clock.monotonic()
                self._stops[client] = _Stop(name, heard_s)
            self.stop(f"by {name}")
        if not room:
            raise RequestRefused(f"{_STOPS_MAX} clients hold the cell already")

    def end_stop(self, client: Hashable) -> None:
        """End the stop of a client, if it has one; nothing is resumed."""
        with self._lock:
            stop = self._stops.pop(client, None)
            if stop is not None:
                self.plugin.remark("hold", f"ended for {stop.name}")

    def leave_stop(self, client: Hashable) -> None:
        """Mark a client as gone; its stop stays."""
        with self._lock:
            if client in self._stops:
                self._stops[client].heard_s = -inf

    @property
    def _gone(self) -> list[Hashable]:
        """Clients that keep the cell stopped and are gone."""
        return [client for client, stop in self._stops.items() if self._is_gone(stop)]

    def _is_gone(self, stop: _Stop) -> bool:
        return self._clock.monotonic() - stop.heard_s > self.config.serve.lease_timeout_s

    def _check_stopped(self, task: str) -> None:
        if self._stops and task not in _UNMOVING:
            raise HeldByClient(
                f"{task}: {', '.join(self.held_by)} keeps the cell on hold; release its button, or "
                "clear the hold of a client that is gone"
            )

    def _begin(
        self,
        lease: int,
        task: str,
        given: Mapping[str, Any],
        number: int,
        begin: Callable[[], Job],
    ) -> int:
        self._poses.settle()
        with self._lock:
            self.lease.alive(lease)
            if number and number <= self._newest:
                _, last_task, last_lease, _ = self._jobs.get(number, (None, "", 0, 0.0))
                if number == self._newest and (last_task, last_lease) == (task, lease):
                    return number
                raise RequestRefused(f"job {number} is another request; the next is {self._next}")
            if number > self._next:
                raise RequestRefused(f"job {number} is not the next job; the next is {self._next}")
            name = self.lease.name
            values = "".join(f", {field} {value}" for field, value in given.items())
            self.plugin.remark("command", f"job {self._next}: {task}{values}, by {name!r}")
            try:
                self._check_stopped(task)
                with self._poses.beginning():
                    job = begin()
            except Exception as error:
                self.plugin.remark("command", f"job {self._next} refused: {error_text(error)}")
                raise
            self._jobs[job.number] = (job, task, lease, time.time())
            self._jobs.pop(job.number - KEPT_JOBS, None)
            self._newest = job.number
            if task not in _KEEPING:
                self._gripped_by = job.number
            return job.number

    @property
    def _next(self) -> int:
        return self._newest + 1

    # -- the pose handshake --------------------------------------------------------------------

    def pose_reached(
        self, lease: int, seq: int, *, ok: bool = True, pose: Pose | None = None
    ) -> None:
        """Answer the pose with that number: reached, refused, or another one reached instead.

        Raises NotInCommand as `Lease.alive`, and RequestRefused if another pose or none is pending.
        """
        with self._lock:
            self.lease.alive(lease)
            self._poses.answer(seq, (pose or True) if ok else False)

    # -- the end -------------------------------------------------------------------------------

    def close(self, timeout_s: float = 30.0) -> None:
        """Stop the running job and disconnect; a held part stays held. Can be called twice.

        Raises ModelError or DatasetError if the taught model cannot be saved; all has ended then.
        """
        self.lease.end_watch()
        self.stop("because the service ends")
        self._poses.stop()
        self.lease.close()
        self.history.close()
        self.plugin.close(timeout_s)

    def _count(self, answer: Answer, found: Identification | None) -> None:
        """Count a part with the present id of its label."""
        self.totals.add(answer, found)
        part = replace(answer, label_id=self.label_id(answer.label))
        self.shift.add(part)
        self.history.add(part)

    def _answered(self, status: HostStatus) -> JobView | None:
        """Return the job of the last answer, even if it is no longer among the kept jobs."""
        answer = status.last_answer
        if answer is None:
            return None
        ended = JobStatus(outcome=JobOutcome.SUCCEEDED, progress={}, value=answer)
        since_s = self._jobs[answer.job][3] if answer.job in self._jobs else 0.0
        return self._view(answer.job, "identify", ended, since_s)

    def _view(self, number: int, task: str, status: JobStatus, since_s: float) -> JobView:
        progress, answer = status.progress, status.value
        found: dict[str, Any] = {
            "label": progress.get("best", ""),
            "n_grasps": progress.get("grasps", 0),
        }
        if task == "sort" and progress.get("label"):
            found = {name: progress[name] for name in ("label", "probability")}
            found["label_id"] = self.label_id(found["label"])
        if isinstance(answer, Answer):
            names = ("label", "probability", "n_grasps", "size_mm", "kept")
            found = {name: getattr(answer, name) for name in names}
            found |= {"label_id": self.label_id(answer.label), "shape": answer.kind}
        elif isinstance(answer, Verification):
            found |= {"held": answer.held, "same": answer.same, "kept": answer.held}
        return JobView(
            number=number,
            task=task,
            since_s=since_s,
            outcome=status.outcome.value,
            outcome_number=OUTCOME_NUMBERS[status.outcome],
            fault_number=status.fault_number,
            error=status.error,
            taught=progress.get("taught"),
            gauged=progress.get("gauged"),
            progress=progress,
            **found,
        )
