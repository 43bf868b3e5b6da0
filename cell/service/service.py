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
from dataclasses import asdict, dataclass, fields
from functools import partial
from importlib.metadata import version
from math import inf
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from cell.build import state_folder
from cell.config.model import CellConfig
from cell.control.identification import Identification
from cell.control.part import Part
from cell.control.plan import Pose
from cell.control.states import CellStatus, Command
from cell.errors import CellError, HeldByClient, RequestRefused
from cell.fault_catalogue import BY_NUMBER, Refusal, error_text
from cell.runtime.goals import TASKS, Goal, GripGoal, IdentifyGoal, SortGoal, checked_goal
from cell.runtime.lease import Lease
from cell.runtime.plugin import HostStatus, TactileCellPlugin
from cell.runtime.worker import Job
from cell.service.history import History, Shift, Totals, history_file
from gripper.clock import Clock
from gripper.errors import GraspStopped

RELEASE_KEY = 0x4F50
"""Key of a release ("OP"): zeroed or repeated outputs of a controller never release a part."""
_STOPS_MAX = 100
"""Most clients that keep the cell stopped; more are refused, but the cell stops."""
_UNMOVING = (Command.CLEAR.value, Command.SHUTDOWN.value)
"""Commands without motion, allowed while a client keeps the cell stopped."""
_KEEPING = (*_UNMOVING, Command.RESET.value, "verify", "forget", "forget_drift")
"""Tasks and commands that leave the part in the grip."""
_POSE_LOOK_S, _POSE_GONE_S = 0.02, 0.05
"""Period in s of the check whether a pose is still needed, and longest wait in s for the end of an
abandoned one before the next job."""
_HOST_COMMANDS = (Command.RELEASE, Command.CLEAR, Command.RESET, Command.SHUTDOWN)
"""Commands of hosts."""

_STATUS_VALUES = ("job", "commander", "held_by", "held_part", "pose_seq", "pose")
"""Values of a `Snapshot` that the state has as they are."""

plain_data = partial(to_jsonable_python, inf_nan_mode="null")
"""Returns JSON types, also of dataclasses; null for each number that is not finite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """Everything that an interface shows, at one moment."""

    status: HostStatus
    """States, live values, last answer."""
    job: Job
    """The newest job."""
    commander: str
    """Name of the client with the lease; empty for none."""
    held_by: tuple[str, ...]
    """Clients that keep the cell on hold; "(gone)" follows the name of a disconnected client."""
    part: Part | None
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


class PoseHandshake:
    """Shows one pose at a time with its number, until the host answers it or the job stops.

    `move` belongs to the thread of the cell; everything else may be called from any thread.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._seq = 0
        self._pose: Pose | None = None
        self._reached: Pose | bool | None = None
        self._moving = False
        self._stopped = False
        self.over: Callable[[], bool] = lambda: False
        """Returns whether the job has ended: a fault does not wait for the host."""

    @property
    def awaited(self) -> tuple[int, Pose | None]:
        """Number and pose that the host shall reach; 0 and None without a pending pose."""
        with self._changed:
            gone = self._pose is None or self._stopped or self.over()
            return (0, None) if gone else (self._seq, self._pose)

    def move(self, pose: Pose) -> Pose | bool:
        """Show a pose and wait for the host: the mover of the cell.

        Raises gripper.errors.GraspStopped if the job ends meanwhile.
        """
        with self._changed:
            self._seq = self._seq % 0xFFFF + 1
            self._pose, self._reached, self._moving = pose, None, True
            try:
                while not (self._stopped or self.over()):
                    if self._changed.wait_for(lambda: self._reached is not None, _POSE_LOOK_S):
                        return self._reached or False
                raise GraspStopped("stopped on request while waiting for a pose")
            finally:
                self._pose, self._moving = None, False
                self._changed.notify_all()

    def answer(self, seq: int, reached: Pose | bool) -> None:
        """Answer the pose with that number: reached, refused, or another one reached instead.

        Raises RequestRefused if another pose or no pose is pending.
        """
        with self._changed:
            expected, _ = self.awaited
            if not expected or seq != expected:
                raise RequestRefused(
                    f"pose {seq} is not pending; the pending pose is {expected or 'none'}"
                )
            self._reached = reached
            self._pose = None
            self._changed.notify_all()

    def stop(self) -> None:
        """Abandon the pending pose, and each further one until a job begins."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def settle(self) -> None:
        """Wait for the end of an abandoned pose, so that the next job can start."""
        with self._changed:
            needed = not (self._stopped or self.over())
            self._changed.wait_for(lambda: needed or not self._moving, _POSE_GONE_S)

    @contextmanager
    def beginning(self) -> Iterator[None]:
        """Begin a job: drop earlier stops, unless an error refuses the job."""
        with self._changed:
            yield
            self._stopped = False


class Service:
    """One cell, its lease, its jobs and its pose handshake; every method from any thread.

    `open_service` opens a cell with its service.

    Parameters
    ----------
    plugin
        The cell, without ``host_timeout_s``: the lease supervises the clients. It is closed with
        the service.
    poses
        Mover of a cell with a positioner of kind ``callback``.
    history_path
        SQLite file of the history; None keeps it in memory.
    note
        Gets messages for the operator.
    clock
        Time of the clients: real time even if the cell's time is virtual.
    """

    def __init__(
        self,
        plugin: TactileCellPlugin,
        config: CellConfig,
        *,
        poses: PoseHandshake | None = None,
        history_path: Path | None = None,
        note: Callable[[str], None] = lambda _text: None,
        clock: Clock = time,
    ) -> None:
        self.config = config
        self.version = version("tactile-cell")
        self.boot = int(time.time()) % 0xFFFF + 1
        """Number of this start, 1 to 65535, from the seconds of its time: it differs at each start.
        """
        self.shift = Shift(config.serve.shift_begins_h, lambda: plugin.status().n_faults)
        """The ledger of the parts."""
        self.totals = Totals()
        """Growing totals, for metrics."""
        self.history = History(history_path, plugin.status, note=note, shift=self.shift)
        """Parts and faults of the days."""
        self.history.start()
        plugin.watch_parts(self._count)
        self.plugin = plugin
        """The cell, for its values; its jobs are started by the service."""
        self._poses = PoseHandshake() if poses is None else poses
        self._poses.over = lambda: plugin.job().terminal
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
        self._newest_lease = self._gripped_by = 0
        self.chosen_part: str | None = None
        """Part between the fingers of the simulated cell for all jobs; None: the next one for each.
        """
        self._in_turn = self._n_in_turn = 0
        self._watched: dict[str, Callable[[], bool]] = {}
        self.lease.watch(note)

    # -- questions -----------------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return everything that interfaces show."""
        with self._lock:
            # Read the job before the answer: the answer is set before the job succeeds.
            job, status = self.plugin.job(), self.plugin.status()
            seq, pose = self._poses.awaited
            last = status.last_answer
            named = last is not None and last.in_grip and last.job >= self._gripped_by
            return Snapshot(
                status=status,
                job=job,
                commander=self.lease.name,
                held_by=self.held_by,
                part=next(iter(self.shift.parts[-1:]), None),
                held_part=last.number if last and named and status.holding else None,
                pose_seq=seq,
                pose=pose,
            )

    def allowed(self) -> dict[str, CellError | None]:
        """Return the error that each task and command would raise now, for a client with the lease.

        None: the task or command is allowed.
        """
        refusals: dict[str, CellError | None] = {}
        with self._lock:
            for task in (*TASKS, *_HOST_COMMANDS):
                try:
                    self._check_stopped(task)
                    if task != Command.CLEAR or not self._gone:
                        self.plugin.check(task)
                    refusals[task] = None
                except CellError as error:
                    refusals[task] = error
        return refusals

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
        given = checked.model_dump(exclude_defaults=True)
        start = partial(self.plugin.start, checked)
        job = self.begin(lease, checked.task, start, number=number, given=given)
        if in_turn and job != self._in_turn:  # a refused or repeated request takes no turn
            self._in_turn, self._n_in_turn = job, self._n_in_turn + 1
        return job

    def _with_part(self, goal: Goal) -> tuple[Goal, bool]:
        """Return a goal with the chosen part, or the next one, for the simulated cell.

        The second value is whether the part is the next one.
        """
        part, in_turn = self.chosen_part, False
        positioner = self.config.positioner
        if not (self.config.simulated or positioner.kind == "simulated" or positioner.socket):
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
                raise RequestRefused(
                    f"release: the key is {key:#x}, not {RELEASE_KEY:#x}; with it the part may fall"
                )
            if command is not Command.CLEAR:
                return self.plugin.start_command(command, reboot=reboot)
            gone = self._gone
            if reboot and len(gone) < len(self._stops):
                raise HeldByClient(
                    f"clear with reboot: {', '.join(self.held_by)} keeps the cell on hold, and a "
                    "restarted servo drops its part; release the button first"
                )
            job = self.plugin.start_command(command, reboot=reboot, needless=bool(gone))
            for client in gone:
                self.end_stop(client)
            return job

        given = {"reboot": True} if reboot else {}
        return self.begin(lease, command.value, begin, number=number, given=given)

    def request(self, lease: int, name: str, *, number: int = 0, **fields: Any) -> int:
        """Start a task or command of a host with plain numbers; return the number of its job.

        Parameters
        ----------
        lease, number
            As `start`.
        name, fields
            Of `cell.interfaces.modbus.registers.COMMANDS`. ``keep`` may be a bool; for fields of a
            task that are 0 or empty the config's values apply.

        Raises as `start`.
        """
        if name not in TASKS:
            key, reboot = fields.get("key", 0), fields.get("reboot", False)
            return self.command(lease, Command(name), key=key, reboot=reboot, number=number)
        if fields.get("keep") == 1:
            fields["keep"] = "always"
        goal = {field: value for field, value in fields.items() if value}
        return self.start(lease, goal | {"task": name}, number=number)

    # -- the simulated cell --------------------------------------------------------------------

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
        self.chosen_part = part
        self.plugin.remark("simulation", f"part {part or 'in turn'} at {pose}")

    def stop(self, reason: str = "on request") -> None:
        """Stop the running job and keep the grip; any client may call this."""
        with self._lock:
            job = self.plugin.job()
            if job.number and not job.terminal:
                self.plugin.remark("hold", reason)
                # First the cell, then the pose: the job ends as held, not as refused by the host.
                self.plugin.cancel(job, reason)
                self._poses.stop()

    @property
    def held_by(self) -> tuple[str, ...]:
        """Names of the clients that keep the cell stopped; clients that are gone are marked."""
        with self._lock:
            stops = self._stops.values()
            return tuple(f"{s.name} (gone)" if self._is_gone(s) else s.name for s in stops)

    def stop_as(self, name: str, latch: bool | None) -> None:
        """Stop for a client without a connection: True begins, False ends, None stops once.

        A name may have any characters: a stop is never refused.
        """
        name = "".join(sign if sign.isprintable() else "?" for sign in name)
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
            for left in [k for k, stop in self._stops.items() if stop.name == name and k != client]:
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

    def begin(
        self,
        lease: int,
        task: str,
        start: Callable[[], Job],
        *,
        number: int = 0,
        given: Mapping[str, Any] | None = None,
    ) -> int:
        """Start any job of the cell for the client in command, and return its number.

        Parameters
        ----------
        lease, number
            As `start`.
        task, given
            Its name and its values, for the recording.
        start
            Starts it.

        Raises as `start`, and the errors of ``start``.
        """
        self._poses.settle()
        with self._lock:
            self.lease.alive(lease)
            newest = self.plugin.job()
            next_ = newest.number + 1
            if number and number < next_:
                last = (newest.number, newest.task, self._newest_lease)
                if (number, task, lease) == last:
                    return number
                raise RequestRefused(f"job {number} belongs to another request; use {next_}")
            if number > next_:
                raise RequestRefused(f"job {number} is not the next job; the next is {next_}")
            values = "".join(f", {field} {value}" for field, value in (given or {}).items())
            self.plugin.remark("command", f"job {next_}: {task}{values}, by {self.lease.name!r}")
            try:
                self._check_stopped(task)
                with self._poses.beginning():
                    job = start()
            except Exception as error:
                self.plugin.remark("command", f"job {next_} refused: {error_text(error)}")
                raise
            self._newest_lease = lease
            if task not in _KEEPING:
                self._gripped_by = job.number
            if task == "simulation_reset":
                self.chosen_part = None
            return job.number

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
        try:
            self.plugin.close(timeout_s)
        finally:
            self.history.close()  # with what ended last

    def _count(self, part: Part, identification: Identification | None) -> None:
        self.totals.add(part, identification)
        self.shift.add(
            part,
            None
            if identification is None
            else self.plugin.newtons.curves(identification.records[-1]),
        )
        self.history.add(part)


def open_service(
    config: CellConfig,
    *,
    note: Callable[[str], None] = lambda _text: None,
    clock: Clock = time,
    **cell: Any,
) -> Service:
    """Open a cell and return its service.

    Parameters
    ----------
    config
        The cell. A positioner of kind ``callback`` is the pose handshake. ``host_timeout_s`` has no
        effect, because the lease supervises the clients.
    note, clock
        As `Service`.
    cell
        Model, folder of the recording and other arguments of `TactileCellPlugin`.

    Raises
    ------
    As `TactileCellPlugin`.
    """
    poses = PoseHandshake()
    plugin = TactileCellPlugin(
        config.model_copy(update={"host_timeout_s": None}),
        mover=poses.move if config.positioner.kind == "callback" else None,
        note=note,
        **cell,
    )
    folder = state_folder(config, cell.get("folder"))
    try:
        plugin.model.read_grasps()  # a service outlives changes of the file
    except BaseException:
        plugin.close()
        raise
    return Service(
        plugin,
        config,
        poses=poses,
        history_path=None if folder is None else history_file(folder, config.name),
        note=note,
        clock=clock,
    )


def state_values(service: Service) -> dict[str, Any]:
    """Return everything except the taxels: JSON types, null for a number that is not finite."""
    now = service.snapshot()
    live = now.status.live
    state: dict[str, Any] = plain_data(
        {
            "time_s": time.time(),
            "status": {field.name: getattr(now.status, field.name) for field in fields(CellStatus)},
            "last_answer": now.status.last_answer,
            "live": {name: getattr(live, name) for name in live.__slots__ if name != "counts"},
            **{name: getattr(now, name) for name in _STATUS_VALUES},
            "allowed": {
                task: None if error is None else Refusal.of(error)
                for task, error in service.allowed().items()
            },
            "fault": _fault(service, now.status),
            "taught_revision": service.plugin.model.revision,
            "health": service.plugin.health(),
            "shift": service.shift.values(),
        }
    )
    return state


def _fault(service: Service, status: HostStatus) -> dict[str, Any] | None:
    if status.fault is None or not status.fault_number:
        return None
    path = service.plugin.recording_path
    return asdict(BY_NUMBER[status.fault_number]) | {
        "detail": status.fault,
        "since_s": status.fault_since_s,
        "recording": None if path is None else str(path),
    }
