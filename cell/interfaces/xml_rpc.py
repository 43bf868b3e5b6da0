"""XML-RPC: the door for robot programs.

A robot program waits for each call and stops at an error: no call takes longer than 100 ms, and
none raises. A method that fails returns a negative number, whose magnitude stands in the fault
catalogue, or an empty text. ``docs/reference/xml-rpc.md`` is made from the methods of `Calls`.
"""

import functools
import inspect
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import ContextVar
from io import BufferedReader
from math import atan2, cos, hypot, inf, sin
from socket import SHUT_RDWR, socket
from socketserver import ThreadingMixIn
from typing import Any, cast
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from cell.config.serve import ServeConfig
from cell.control.plan import Pose
from cell.control.states import Command
from cell.errors import ConfigError, NotMeasured, RequestRefused
from cell.fault_catalogue import Refusal, for_display
from cell.interfaces.plugin.goals import goal_of
from cell.interfaces.service.doors import (
    BUSY_MAX,
    Places,
    is_for_this_machine,
    may_connect,
    notice_dead_peers,
    read_secret,
    same_secret,
)
from cell.interfaces.service.service import Service

_REFUSALS_MAX = 100
"""Clients whose last refusal is kept; that of the one that was refused first goes first."""
LONGEST = 65536
"""Largest request in bytes."""
_CLIENT: ContextVar[str] = ContextVar("client", default="")
"""Address of the client whose call is answered on this thread; empty where that is not known."""
_IDLE_S = 60.0
"""Silence in s after which a connection is closed; robots connect anew by themselves."""


def ur_pose(pose: Pose | None) -> dict[str, float]:
    """Return a pose as URScript takes it, in the grip frame: m, and a rotation vector in rad.

    The object is first rolled about its long axis (x), then turned about the approach axis (z).
    """
    if pose is None:
        pose = Pose()
    turn, roll = pose.rotation_rad / 2, pose.roll_rad / 2
    # Product of the two unit quaternions.
    axis = (cos(turn) * sin(roll), sin(turn) * sin(roll), sin(turn) * cos(roll))
    length = hypot(*axis)
    angle_rad = 2 * atan2(length, cos(turn) * cos(roll))
    scale = angle_rad / length if length else 0.0
    rotation = dict(zip(("rx", "ry", "rz"), (scale * part for part in axis), strict=True))
    return {"x": pose.x_m, "y": pose.y_m, "z": 0.0} | rotation


def _measured(value: float | None) -> float:
    if value is None:
        raise NotMeasured("the value is not measured at the moment; read the state of the cell")
    return value


class Calls:
    """The methods; types are int, double, bool, string and pose only.

    `acquire` asks for the secret; an empty one is not asked for.
    """

    def __init__(self, service: Service, secret: str = "", *, door: str = "XML-RPC") -> None:
        self._service = service
        self._secret = secret
        self._door = door
        self._refusals: dict[str, Refusal] = {}

    def _refuse(self, error: Exception) -> int:
        """Take note why a call of this client is refused; return the number."""
        if isinstance(error, TypeError):  # wrong arguments are the request's fault
            error = ConfigError(str(error))
        refusal, client = Refusal.of(error), _CLIENT.get()
        if not isinstance(error, NotMeasured):  # nothing was asked for that could be refused
            self._refusals.pop(client, None)
            self._refusals[client] = refusal
            if len(self._refusals) > _REFUSALS_MAX:
                self._refusals.pop(next(iter(self._refusals)), None)
        return refusal.number

    @property
    def refusal(self) -> Refusal:
        """Why the last refused call of this address was."""
        return self._refusals.get(_CLIENT.get(), Refusal())

    def acquire(self, secret: str, name: str = "") -> int:
        """Return the lease to command with; keep it with `alive`.

        Without `serve.secret_file` the only argument is the name.
        """
        if not self._secret:
            return self._service.acquire(name or secret)
        if not same_secret(str(secret), self._secret):
            raise RequestRefused("acquire: the first argument is not that of serve.secret_file")
        return self._service.acquire(name or "a client with the secret")

    def alive(self, lease: int) -> int:
        """Keep the lease; return 0. Every command keeps it too."""
        self._service.alive(lease)
        return 0

    def give_up(self, lease: int) -> int:
        """Give the lease up; return 0. A job that runs is held."""
        self._service.give_up(lease)
        return 0

    def state(self) -> int:
        """Return the state of the cell: number of PackTags."""
        return self._service.status().state_number

    def needs_reset(self) -> bool:
        """Return whether an acknowledged fault waits for `reset`."""
        return self._service.status().needs_reset

    def grip_state(self) -> int:
        """Return the state of the grip, 0 to 7."""
        return self._service.status().grasp_number

    def holding(self) -> bool:
        """Return whether a part may be in the grip."""
        return self._service.status().holding

    def force(self) -> float:
        """Return the grip force in N; -516 where it is not measured."""
        return _measured(self._service.status().live.force_n)

    def force_age(self) -> float:
        """Return the age in s of the newest valid force; -516 where none was measured."""
        return _measured(self._service.status().live.force_age_s)

    def opening(self) -> float:
        """Return the opening between the fingers in mm; -516 where it is not measured."""
        return _measured(self._service.status().live.opening_mm)

    def frame_age(self) -> float:
        """Return the age in s of the newest frame of the taxels; -516 where none was measured."""
        return _measured(self._service.status().live.frame_age_s)

    def next_job(self) -> int:
        """Return the number of the next job: given to a command, it makes repeating it harmless."""
        return self._service.job().number + 1

    def teach(self, lease: int, label: str, grasps: int, job: int = 0) -> int:
        """Start to teach an object; return the job."""
        goal = {"task": "teach", "label": label, "grasps": grasps}
        return self._service.start(lease, goal, number=job)

    def identify(
        self, lease: int, max_grasps: int, force_n: float, keep: bool, job: int = 0
    ) -> int:
        """Start an identification; return the job. 0 grasps and 0 N: as the config has it."""
        kept = "always" if keep else "never"
        goal = goal_of("identify", max_grasps=max_grasps, force_n=float(force_n), keep=kept)
        return self._service.start(lease, goal, number=job)

    def grip(self, lease: int, force_n: float, job: int = 0) -> int:
        """Start to grip a part and keep it, without a name; return the job."""
        goal = {"task": "grip", "force_n": float(force_n)}
        return self._service.start(lease, goal, number=job)

    def verify(self, lease: int, job: int = 0) -> int:
        """Start to look whether the held part is still the same; return the job."""
        return self._service.start(lease, {"task": "verify"}, number=job)

    def zero(self, lease: int, job: int = 0) -> int:
        """Start to measure the zero with empty fingers on each other; return the job."""
        return self._service.start(lease, {"task": "zero"}, number=job)

    def sort(self, lease: int, parts: int, max_grasps: int, force_n: float, job: int = 0) -> int:
        """Start to name parts and let each go at its place of `sort.places`; return the job."""
        goal = goal_of("sort", parts=parts, max_grasps=max_grasps, force_n=float(force_n))
        return self._service.start(lease, goal, number=job)

    def release(self, lease: int, key: int, job: int = 0) -> int:
        """Start to let the part go, with key 20304 (0x4F50); return the job."""
        return self._service.command(lease, Command.RELEASE, key=key, number=job)

    def clear(self, lease: int, job: int = 0, reboot: bool = False) -> int:
        """Start to acknowledge the fault; return the job. `reboot` restarts servos at fault."""
        return self._service.command(lease, Command.CLEAR, reboot=reboot, number=job)

    def reset(self, lease: int, job: int = 0) -> int:
        """Start to verify the devices anew, also after a shutdown; return the job."""
        return self._service.command(lease, Command.RESET, number=job)

    def shutdown(self, lease: int, job: int = 0) -> int:
        """Start to end the work with the devices; a held part stays held. Return the job."""
        return self._service.command(lease, Command.SHUTDOWN, number=job)

    def hold(self, latch: int = -1, name: str = "") -> int:
        """Stop what runs and keep the grip; anyone may. Return 0.

        With `latch` 1 nothing that moves starts until the same client, by address and name, calls
        with 0; -1: once. A pressed button repeats 1 at least each `serve.lease_timeout_s`.
        """
        who = " ".join(filter(None, (self._door, _CLIENT.get(), str(name)[:60])))
        self._service.hold_as(who, None if latch < 0 else bool(latch))
        return 0

    def held_by(self) -> str:
        """Return the clients that keep the cell on hold; empty for none."""
        return ", ".join(self._service.held_by)

    def job_state(self, job: int) -> int:
        """Return how a job is: 1 accepted, 2 running, 4 done, 5 held on request, 6 aborted."""
        return self._service.job(job).outcome_number

    def job_fault(self, job: int) -> int:
        """Return the fault number of a job that failed; 0 else."""
        return self._service.job(job).fault_number

    def job_text(self, job: int) -> str:
        """Return why a job failed, the remedy first; empty else."""
        found = self._service.job(job)
        return for_display(found.fault_number, found.error)

    def last_refusal(self) -> str:
        """Return why the last refused call of this address was: number, text, remedy; empty: none.

        A value that is not measured is no refusal.
        """
        return str(self.refusal)

    def boot(self) -> int:
        """Return a number that differs after each start of the cell's program, 1 to 65535."""
        return self._service.boot

    def last_answer(self) -> int:
        """Return the job of the last identification, for `label_id` and others; 0: no answer.

        It stays until the next identification begins, whatever jobs come in between.
        """
        answer = self._service.status().last_answer
        return 0 if answer is None else answer.job

    def label_id(self, job: int) -> int:
        """Return the id of the label found, from 1; 0 while not known, and for UNKNOWN."""
        return self._service.job(job).label_id

    def label(self, job: int) -> str:
        """Return the label found; before the end the likeliest so far."""
        return self._service.job(job).label

    def probability(self, job: int) -> float:
        """Return the probability of the label, 0 to 1; 0 before the end."""
        return self._service.job(job).probability

    def same(self, job: int) -> int:
        """Return what a verification found: 1 the same part, 0 another or none; -1 not over."""
        found = self._service.job(job)
        return -1 if found.held is None else int(bool(found.held and found.same))

    def pose_seq(self) -> int:
        """Return the number of the pose that is waited for; 0 for none."""
        return self._service.snapshot().pose_seq

    def next_pose(self) -> dict[str, float]:
        """Return the pose that the object shall have in the grip frame."""
        return ur_pose(self._service.snapshot().pose)

    def pose_reached(self, lease: int, seq: int, ok: bool) -> int:
        """Answer the pose with that number: reached, or refused; return 0."""
        self._service.pose_reached(lease, seq, ok=ok)
        return 0

    def fault_number(self) -> int:
        """Return the number of the latched fault; 0 for none."""
        return self._service.status().fault_number

    def fault_text(self) -> str:
        """Return the latched fault as text; empty for none."""
        return self._service.status().fault or ""


_TYPES = {int: "int", float: "double", bool: "boolean", str: "string"}
"""Names of the types in XML-RPC."""
_EMPTY: Mapping[str, Any] = {
    "label": "",
    "fault_text": "",
    "held_by": "",
    "job_text": "",
    "last_refusal": "",
    "next_pose": ur_pose(None),
}
"""What methods that return no number return where they fail."""


METHODS = {
    name: method
    for name, method in vars(Calls).items()
    if inspect.isfunction(method) and name[0] != "_"
}
"""Methods of `Calls` by name."""


def methods(calls: Calls) -> dict[str, Callable[..., Any]]:
    """Return all methods by name; none of them raises."""
    return {
        name: _harmless(name, getattr(calls, name), calls._refuse)  # noqa: SLF001  as a method
        for name in METHODS
    }


def _harmless(
    name: str, call: Callable[..., Any], refuse: Callable[[Exception], int]
) -> Callable[..., Any]:
    @functools.wraps(call)
    def called(*arguments: Any) -> Any:
        try:
            return call(*arguments)
        except Exception as error:
            number = refuse(error)
            found = _EMPTY.get(name, -number)
            return float(found) if call.__annotations__["return"] is float else found

    return called


class _Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ("/", "/RPC2")
    protocol_version = "HTTP/1.1"  # robots keep the connection
    timeout = _IDLE_S
    disable_nagle_algorithm = True
    server: "_Server"
    connection: socket
    rfile: BufferedReader

    def handle_one_request(self) -> None:
        """Answer a request, which has a limit of time from its first byte on."""
        _CLIENT.set(self.client_address[0])  # the thread is of this connection alone
        self.rfile.peek(1)
        self.server.begun(self.connection)
        super().handle_one_request()
        self.server.answered(self.connection)

    def do_POST(self) -> None:  # noqa: N802  name of the base class
        """Answer a request that no web page has made, whose length is stated and small."""
        hosts = self.headers.get_all("Host", ())
        reached = str(self.connection.getsockname()[0])
        if "Origin" in self.headers:
            self._refuse(403, "no web page of any origin")
            return
        if not is_for_this_machine(hosts, reached, self.server.config):
            self._refuse(403, "the header Host is not this machine: serve.hosts adds names")
            return
        if self.headers.get_content_type() != "text/xml":
            self._refuse(403, "the Content-Type is text/xml")
            return
        length = self.headers.get("Content-Length", "")
        chunked = "Transfer-Encoding" in self.headers
        if chunked or not length.isdecimal() or int(length) > LONGEST:
            self._refuse(413, f"a request has a Content-Length of at most {LONGEST}")
            return
        super().do_POST()

    def _refuse(self, status: int, reason: str) -> None:
        self.close_connection = True
        self.send_error(status, reason)

    def decode_request_content(self, data: bytes) -> bytes | None:
        """Refuse what may grow large, compressed or a document type, and what was cut off."""
        if len(data) != int(self.headers["Content-Length"]):
            self._refuse(400, "the request is shorter than its Content-Length")
            return None
        if self.headers.get("content-encoding", "identity") != "identity" or b"<!" in data:
            self._refuse(501, "no compression, no document type")
            return None
        return data

    def log_message(self, *_args: Any) -> None:
        """Write nothing: the console is the operator's."""


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    allow_reuse_address = True
    request_queue_size = BUSY_MAX

    def __init__(self, config: ServeConfig) -> None:
        self.config = config
        self._places: Places[socket] = Places(_end, lambda request: request.fileno() < 0)
        self._due_s: dict[socket, float] = {}
        super().__init__(
            (config.listen, config.xmlrpc_port or 0),
            requestHandler=_Handler,
            logRequests=False,
            allow_none=False,
        )
        self.register_introspection_functions()

    def system_methodSignature(self, method_name: str) -> Any:  # noqa: N802  name of the base class
        """Return the types of a method: what it returns, then its arguments; once with all."""
        if method_name not in self.funcs or method_name.startswith("system."):
            return super().system_methodSignature(method_name)
        found = inspect.signature(self.funcs[method_name])
        taken = (one.annotation for one in found.parameters.values())
        return [[_TYPES.get(one, "struct") for one in (found.return_annotation, *taken)]]

    def verify_request(self, request: Any, client_address: Any) -> bool:
        return may_connect(client_address[0], self.config)

    def process_request(self, request: Any, client_address: Any) -> None:
        self._due_s[request] = inf
        notice_dead_peers(request)
        self._places.enter(request, client_address[0])
        super().process_request(request, client_address)

    def begun(self, request: socket) -> None:
        """Take note of the first byte of a request."""
        self._due_s[request] = time.monotonic() + self.config.request_timeout_s

    def answered(self, request: socket) -> None:
        """Take note that a request is answered."""
        self._due_s[request] = inf
        self._places.heard(request)

    def service_actions(self) -> None:
        """End connections whose request takes too long; called between two looks for new ones."""
        now_s = time.monotonic()
        for request, due_s in tuple(self._due_s.items()):
            if due_s < now_s:
                _end(request)

    def shutdown_request(self, request: Any) -> None:
        self._due_s.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Pass over a connection that broke; it is closed."""

    def end(self) -> None:
        """End all connections, then wait for their threads."""
        self.shutdown()
        for request in tuple(self._due_s):
            _end(request)
        self.server_close()


def _end(request: socket) -> None:
    with suppress(OSError):
        request.shutdown(SHUT_RDWR)


class XmlRpcDoor:
    """The cell behind XML-RPC.

    Raises
    ------
    OSError
        If it cannot listen at the configured address and port, or the file of the secret be read.
    ConfigError
        If the secret is too short.
    """

    def __init__(self, service: Service) -> None:
        config = service.config.serve
        secret = read_secret(config.secret_file) if config.secret_file else ""
        self._server = _Server(config)
        for name, method in methods(Calls(service, secret)).items():
            self._server.register_function(method, name)
        self.port: int = cast("tuple[str, int]", self._server.server_address)[1]
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="xml-rpc", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End all connections and the thread."""
        self._server.end()
        self._thread.join()
