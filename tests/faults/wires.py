"""The cell of the state machine behind an interface: the same commands, sent by one of its hosts.

`WireDriver` is the driver of `tests.faults.driver` with a service between it and the cell. Each
answer is checked against the table of states, and each request is sent twice.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from cell.build import Cell, build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.keeping import Keep
from cell.control.states import CellState, Command, command_effect
from cell.errors import CellError, HeldByClient
from cell.fault_catalogue import fault_number
from cell.interfaces.opening import open_interfaces
from cell.runtime.worker import Job
from cell.service.service import RELEASE_KEY, Service, open_service
from tests.cell.interfaces.hosts import HOSTS, NOT_IN_COMMAND, Request
from tests.faults.campaign import PRODUCT_ERRORS
from tests.faults.driver import COMMAND_BOUND_S, Driver
from tests.faults.invariants import FrameWitness, InvariantBroken, Overrun
from tests.fuzz.harness import Clock

LEASE_S = 60.0
"""Time-out of leases in s: only the clock of the test lets it pass."""
PATIENCE_S = 60.0
"""Longest real time in s of a job or of an answer: later it hangs."""
STARTS = 5
"""Starts of a service, with all faults healed after the first one, until it must be there."""
ON_HOLD = fault_number(HeldByClient(""))
LATCHES_NOTHING = (200, 507, 510, 511)
"""Fault numbers of jobs after which the cell is ready: limits, plan, pose, no part."""
SUCCEEDED, CANCELED = 4, 5
INTERFACES = ("modbus", "xmlrpc", "http")
"""Those behind which the machine walks."""


# -- the service -------------------------------------------------------------------------------


class WitnessModel:
    """A taught model whose recogniser looks at its frames; each grasp has the same pose."""

    labels, revision, drift, shapes = ("ball", "box"), 0, None, SimpleNamespace(reader=None)
    ends_early = True

    def __init__(self, config: CellConfig, witness: Callable[[], FrameWitness]) -> None:
        ranges = dict.fromkeys(("x_mm", "y_mm", "rotation_deg", "roll_deg"), (0.0, 0.0))
        changes = {f"sequence.{name}": range_ for name, range_ in ranges.items()}
        self.config = changed_config(config, changes | {"sequence.max_grasps": 1})
        self._witness = witness

    @property
    def recognizer(self) -> FrameWitness:
        return self._witness()

    def check_extendable(self) -> None:
        """Do nothing: its training set is at hand."""

    def check_taught(self) -> None:
        """Do nothing: it is taught."""

    def remark_on(self, _records: Any) -> str:
        return ""


class WireDriver(Driver):
    """The driver of a cell behind an interface; see `tests.faults.driver`.

    Beside the invariants of the cell each command is judged: whether it is refused, where the cell
    is after it, and what the interface shows, as the tables of states and faults have it. A
    request that is repeated, at once or later, does nothing more.
    """

    interface = ""

    def __init__(self, *, self_test: bool, fast: bool = False) -> None:
        self.clock = Clock()
        self._ending: list[Callable[[], None]] = []
        self._held = False
        self._due: list[Callable[[float], None]] = []
        super().__init__(self_test=self_test, fast=fast)

    # -- commands ------------------------------------------------------------------------------

    def start(self) -> bool:
        return self.reset()

    def grasp(self, x_mm: float, force_n: float, turn_rad: float) -> bool:
        return self.ask(Request(task="identify", force_n=force_n, max_grasps=1), Command.GRASP)

    def identify(self, force_n: float, keep: Keep = Keep.NEVER) -> bool:
        return self.ask(Request(task="identify", force_n=force_n, keep=keep), Command.GRASP)

    def grip(self, force_n: float) -> bool:
        return self.ask(Request(task="grip", force_n=force_n), Command.GRIP)

    def verify(self) -> bool:
        return self.ask(Request(task="verify"), Command.VERIFY)

    def release(self) -> bool:
        for key in (0, RELEASE_KEY >> 8 | (RELEASE_KEY & 0xFF) << 8):
            self.ask(Request(task="release", key=key), None)
        waiting = self.controller.life.state in (CellState.STOPPED, CellState.RESETTING)
        command = Command.RELEASE_HELD if waiting else Command.RELEASE
        return self.ask(Request(task="release", key=RELEASE_KEY), command)

    def release_held(self) -> bool:
        return self.release()

    def clear(self, *, reboot: bool) -> bool:
        return self.ask(Request(task="clear", reboot=reboot), Command.CLEAR)

    def reset(self) -> bool:
        stopped = self.controller.life.state is CellState.STOPPED
        return self.ask(Request(task="reset"), Command.START if stopped else Command.RESET)

    def shutdown(self) -> bool:
        return self.ask(Request(task="shutdown"), Command.SHUTDOWN)

    def cancel(self) -> None:
        """Hold while nothing runs: nothing happens, to the next command neither.

        While a button is pressed all that would move something is refused, in every state.
        """
        before = self._seen()
        self.command("hold", self._wire.hold)
        self.command("press", partial(self._wire.hold, True))
        moving = (
            Request(task="grip", force_n=3.0),
            Request(task="release", key=RELEASE_KEY),
            Request(task="reset"),
        )
        for request in moving if self._service.lease.has(self._lease()) else ():
            found = self._wire.send(request, self._service.plugin.job().number + 1)
            self._expect(found == -ON_HOLD, f"{request.task}: {found} while a button is pressed")
            if found != -ON_HOLD:
                break
        self.command("let go", partial(self._wire.hold, False))
        self._expect(self._seen() == before, f"hold has changed {before} to {self._seen()}")
        self.check()

    def cancel_soon(self, after_s: float) -> None:
        """Let another client hold in so many s, or the one in command fall silent."""
        silent = int(1e3 * after_s) % 3 == 0
        due_s = self.simulated.clock.monotonic() + after_s
        self._begin(f"{'lose the lease' if silent else 'hold'} in {after_s} s")

        def look(now_s: float) -> None:
            if now_s < due_s:
                return
            self._forget(look)
            self._held = True
            if silent:
                self.clock.now_s += LEASE_S + 1.0
                self._service.lease.has(0)
            else:
                self._wire.hold()

        self._due.append(look)
        self.simulated.clock.on_advance.append(look)
        self._end()

    def _forget(self, look: Callable[[float], None]) -> None:
        self._due.remove(look)
        self.simulated.clock.on_advance.remove(look)

    def ask(self, request: Request, command: Command | None) -> bool:
        """Send a request, wait for the end of its job, and judge both; whether it succeeded.

        The command is that of the table of states; None where the request has to be refused.
        """
        values = (f"{name}={value}" for name, value in asdict(request).items() if value)
        self._begin(f"{self.interface}: {' '.join(values)}")
        if not self._service.lease.has(self._lease()):
            self._refuse_without_lease(request)
        before, self._held = self._seen(), False
        letting_go = command in (Command.RELEASE, Command.RELEASE_HELD)
        done = False
        try:
            with self.monitor.bounded(COMMAND_BOUND_S), self._asked(request, release=letting_go):
                done = self._sent(request, command, before)
        except (InvariantBroken, Overrun, OSError, TimeoutError, CellError) as error:
            self._expect(False, f"{type(error).__name__}: {error}")
        self._look_at_interface()
        self._end()
        return done

    @contextmanager
    def _asked(self, request: Request, *, release: bool) -> Iterator[None]:
        if release or request.reboot:
            with self.monitor.release_asked(motion=release):
                yield
        else:
            yield

    def _sent(self, request: Request, command: Command | None, before: tuple[Any, ...]) -> bool:
        state, number = self.controller.life.state, self._service.plugin.job().number + 1
        found = self._wire.send(request, number)
        again = self._wire.repeat()
        # The lease may end between the request and its repetition.
        same = again == found or not self._service.lease.has(self._lease())
        self._expect(same, "a repeated request has another answer")
        allowed = command is not None and command_effect(state, command).accepted
        if found < 0:
            self.log[-1] += f" -> refused, {-found}"
            self._expect(not allowed, f"{request.task} is refused in {state} with {-found}")
            self._expect(self._seen() == before, f"a refusal has changed {before}")
            return False
        self._expect(allowed, f"{request.task} is accepted in {state}")
        self._expect(found == number, f"the job has number {found}, not {number}")
        service = self._service
        service.plugin._worker.wait(service.plugin.job(found), PATIENCE_S)
        job, after = service.plugin.job(found), self._seen()
        self.log[-1] += f" -> {job.outcome} {job.error[:100]}"
        if allowed and command is not None:
            self._judge_end(job, state, command)
        if self._service.lease.has(self._lease()):
            self._expect(self._wire.repeat() == found, "a late repetition has another answer")
            self._expect(self._seen() == after, f"a late repetition has changed {after}")
        return job.outcome_number == SUCCEEDED

    def _judge_end(self, job: Job, before: CellState, command: Command) -> None:
        """Judge where the cell is after a job, by the table of states and the fault catalogue."""
        state, fault = self.controller.life.state, self._service.plugin.status().fault_number
        path = command_effect(before, command).path
        if command is Command.RESET:  # over a link a reset starts the cell too
            path += command_effect(CellState.STOPPED, Command.START).path
        at_end = path[-1] if path else before
        if job.part is not None and job.part.kept:
            at_end = CellState.COMPLETE
        for word in ("InvariantBroken", "Overrun"):
            self._expect(word not in job.error, job.error)
        if job.outcome_number == SUCCEEDED:
            self._expect(job.fault_number == 0, f"success with fault {job.fault_number}")
            self._expect(state is at_end, f"{state} after {command} in {before}, not {at_end}")
        elif job.outcome_number == CANCELED:
            held = {before} | {CellState.HELD for one in path if one is CellState.EXECUTE}
            held |= {CellState.STOPPED for one in path if one is CellState.STARTING}
            self._expect(self._held, f"stopped, though nobody held it: {job.error}")
            self._expect(state in held, f"{state} after a hold of {command} in {before}")
        elif fault:
            self._expect(job.fault_number != 0, f"no fault number for: {job.error}")
        else:
            ready = job.fault_number in LATCHES_NOTHING and state is CellState.IDLE
            stopped = command is Command.SHUTDOWN and state is CellState.STOPPED
            self._expect(ready or stopped, f"{state} without a fault after {job.error}")

    def _refuse_without_lease(self, request: Request) -> None:
        """See that nothing is done for a client without the lease, then take it again."""
        before = self._seen()
        found = self._wire.send(request, self._service.plugin.job().number + 1)
        self._expect(found == -NOT_IN_COMMAND, f"{found} for a client without the lease")
        self._expect(self._seen() == before, f"a client without the lease has changed {before}")
        self._expect(self._wire.acquire() == 0, "the lease is free, and is not given")

    # -- what is seen --------------------------------------------------------------------------

    def _expect(self, true: bool, complaint: str) -> None:
        if not true:
            self.monitor.broken.append(complaint)

    def _lease(self) -> int:
        return self._service.lease.number

    def _seen(self) -> tuple[Any, ...]:
        """Return what a request that is refused or repeated may not change."""
        now_s = self.simulated.clock.monotonic()
        return now_s, self._service.plugin.status(), self._service.plugin.job()

    def _look_at_interface(self) -> None:
        """Judge that the interface shows what is, and that state and fault number agree."""
        status, job = self._service.plugin.status(), self._service.plugin.job()
        expected = {
            "state": status.state_number,
            "needs_reset": status.needs_reset,
            "grip": status.grasp_number,
            "holding": status.holding,
            "fault": status.fault_number,
            "job": job.number,
        }
        if job.number:
            expected["outcome"] = job.outcome_number
        found = self._wire.shown()
        shown = {name: found[name] for name in expected}
        self._expect(shown == expected, f"the interface shows {shown}, it is {expected}")
        aborted = status.state == CellState.ABORTED
        self._expect(aborted == (status.fault_number != 0), f"state and fault disagree: {status}")

    # -- the host ------------------------------------------------------------------------------

    def _new_host(self) -> Cell:
        def built(*arguments: Any, **options: Any) -> Cell:
            cell = build_cell(*arguments, **options, simulated=self.simulated)
            self.monitor.attach(cell)
            return cell

        with patch("cell.build.build_cell", built):
            self._service = self._new_service()
        plugin: Any = self._service.plugin
        model = WitnessModel(plugin._config, self.witness)
        for user in (plugin._file, plugin._tasks, plugin._tasks.parts):
            user.model = model
        plugin.model = model
        interfaces = open_interfaces(self._service)
        self._wire = HOSTS[self.interface](interfaces.__enter__())
        self._ending = [self._wire.close, lambda: interfaces.__exit__(None, None, None)]
        assert self._wire.acquire() == 0
        return self._service.plugin.cell

    def _new_service(self) -> Service:
        """Start the service; one that a fault keeps from it is started again without faults."""
        ports = {
            f"serve.{interface}_port": 0 if interface == self.interface else None
            for interface in INTERFACES
        }
        config = changed_config(self._config, ports | {"serve.lease_timeout_s": LEASE_S})
        error: Exception | None = None
        for _ in range(STARTS):
            try:
                with self.monitor.bounded(COMMAND_BOUND_S):
                    return open_service(config, folder=self._host_folder(), clock=self.clock)
            except PRODUCT_ERRORS as refused:
                error = refused
                self.monitor.attach(None)
            self.simulated.injector.clear_all()
            for motor in self.simulated.devices.mechanics.motors:
                motor.encoder_offset_rad, motor.temperature_c = 0.0, 25.0
            self.simulated.clock.sleep(0.5)
        raise InvariantBroken(f"no service on healed hardware: {error}")

    def _close_host(self) -> None:
        for look in tuple(self._due):
            self._forget(look)
        for end in self._ending:
            end()
        self._service.close()


def driver_of(interface: str) -> type[WireDriver]:
    """Return the driver of cells behind that interface."""
    return type(f"{interface}Driver", (WireDriver,), {"interface": interface})
