"""XML-RPC: the interface for robot programs.

A robot program waits for each call and stops at an error. So no call takes longer than 100 ms or
raises an error. A method that fails returns the negative fault number, or an empty text;
`Calls.last_refusal` has the reason.
"""

import asyncio
import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from math import atan2, cos, hypot, sin
from typing import Any, cast
from xmlrpc.server import SimpleXMLRPCDispatcher

from starlette.responses import Response

from cell.control.part import Part
from cell.control.plan import Pose
from cell.errors import ConfigError, NotMeasured, RequestRefused
from cell.fault_catalogue import Refusal, for_display
from cell.interfaces.access import read_secret, same_secret
from cell.interfaces.http_server import HttpServer, Scope, Send, refusal
from cell.service.service import Service

CLIENT: ContextVar[str] = ContextVar("client", default="")
"""Address of the client of the present call; empty if not known."""
_REFUSALS_MAX = 100
"""Most clients whose last refusal is kept; the oldest refusal is dropped first."""
_PATHS = ("/", "/RPC2")
"""Paths of the calls."""
_REMEDY = f"POST calls to {_PATHS[1]}, as text/xml in UTF-8, without compression and DOCTYPE."
"""Remedy for a request that is not a call."""
_IDLE_S = 60
"""Silence in s after which a connection is closed; robots reconnect by themselves."""


class Calls:
    """The methods for robot programs; types are int, float, bool, str and pose only.

    `methods` returns them so that they never raise. `acquire` checks the secret if it is not empty.
    """

    def __init__(self, service: Service, secret: str = "") -> None:
        self._service = service
        self._secret = secret
        self._refusals: dict[str, Refusal] = {}

    def _refuse(self, error: Exception) -> int:
        """Store why a call of this client is refused; return the number."""
        refusal, client = Refusal.of(error), CLIENT.get()
        if not isinstance(error, NotMeasured):  # a missing value is not a refusal
            self._refusals.pop(client, None)
            self._refusals[client] = refusal
            if len(self._refusals) > _REFUSALS_MAX:
                self._refusals.pop(next(iter(self._refusals)), None)
        return refusal.number

    def acquire(self, secret: str, name: str = "") -> int:
        """Return the number of the lease for commands; keep it with `alive`.

        Without `serve.secret_file` the only argument is the name.
        """
        if not self._secret:
            return self._service.lease.acquire(name or secret)
        if not same_secret(str(secret), self._secret):
            raise RequestRefused("acquire: the first argument must be that of serve.secret_file")
        return self._service.lease.acquire(name or "a client with the secret")

    def alive(self, lease: int) -> int:
        """Keep the lease; return 0. Every command keeps it too."""
        self._service.lease.alive(lease)
        return 0

    def give_up(self, lease: int) -> int:
        """Give the lease up; return 0. A running job is put on hold."""
        self._service.lease.give_up(lease)
        return 0

    def hold(self, latch: int = -1, name: str = "") -> int:
        """Stop the running job and keep the grip; needs no lease. Return 0.

        After `latch` 1 no motion starts until the same client, by address and name, calls with 0;
        -1: stop once. A pressed button repeats 1 within each `serve.lease_timeout_s`.
        """
        who = " ".join(filter(None, ("XML-RPC", CLIENT.get(), str(name)[:60])))
        self._service.stop_as(who, None if latch < 0 else bool(latch))
        return 0

    def boot(self) -> int:
        """Return a number that differs after each start of the program, 1 to 65535."""
        return self._service.boot

    def next_job(self) -> int:
        """Return the number of the next job: a command with it can be repeated safely."""
        return self._service.plugin.job().number + 1

    def job_text(self, job: int) -> str:
        """Return why a job failed, the remedy first; else an empty text."""
        record = self._service.plugin.job(job)
        return for_display(record.fault_number, record.error)

    def same(self, job: int) -> int:
        """Return a verification: 1 same part, 0 another or none, -1 running; others are refused."""
        record = self._service.plugin.job(job)
        verification = record.verification
        if verification is None and record.terminal:
            raise RequestRefused(f"job {job}, {record.task}, has ended without a verification")
        return -1 if verification is None else int(bool(verification.held and verification.same))

    def next_pose(self) -> dict[str, float]:
        """Return the requested pose of the object in the grip frame."""
        return ur_pose(self._service.snapshot().pose)

    def pose_reached(self, lease: int, seq: int, ok: bool) -> int:
        """Answer the pose with that number: reached or refused; return 0."""
        self._service.pose_reached(lease, seq, ok=ok)
        return 0

    def last_refusal(self) -> str:
        """Return number, text and remedy of the last refused call of this address; empty: none.

        A value that is not measured is not a refusal.
        """
        return str(self._refusals.get(CLIENT.get(), Refusal()))

    def state(self) -> int:
        """Return the state of the cell: number of PackTags."""
        return self._service.plugin.status().state_number

    def needs_reset(self) -> bool:
        """Return whether an acknowledged fault waits for reset."""
        return self._service.plugin.status().needs_reset

    def held_by(self) -> str:
        """Return the clients that keep the cell on hold; empty: none."""
        return ", ".join(self._service.held_by)

    def grip_state(self) -> int:
        """Return the state of the grip, 0 to 7."""
        return self._service.plugin.status().grasp_number

    def holding(self) -> bool:
        """Return whether a part may be in the grip."""
        return self._service.plugin.status().holding

    def force(self) -> float:
        """Return the grip force in N; -516 if it is not measured."""
        return _measured(self._service.plugin.status().live.force_n)

    def force_age(self) -> float:
        """Return the age in s of the newest valid force; -516 if it is not measured."""
        return _measured(self._service.plugin.status().live.force_age_s)

    def opening(self) -> float:
        """Return the opening between the fingers in mm; -516 if it is not measured."""
        return _measured(self._service.plugin.status().live.opening_mm)

    def frame_age(self) -> float:
        """Return the age in s of the newest frame of the taxels; -516 if it is not measured."""
        return _measured(self._service.plugin.status().live.frame_age_s)

    def job_state(self, job: int) -> int:
        """Return its state: 1 accepted, 2 running, 4 done, 5 stopped on request, 6 aborted."""
        return self._service.plugin.job(job).outcome_number

    def job_fault(self, job: int) -> int:
        """Return the fault number of a failed job; else 0."""
        return self._service.plugin.job(job).fault_number

    def label(self, job: int) -> str:
        """Return the label; before the end the likeliest label so far."""
        return (self._service.plugin.job(job).part or Part()).label

    def label_id(self, job: int) -> int:
        """Return the id of the label, from 1; 0: not known yet, or UNKNOWN."""
        return (self._service.plugin.job(job).part or Part()).label_id

    def probability(self, job: int) -> float:
        """Return the probability of the label, 0 to 1; 0 before the end."""
        return (self._service.plugin.job(job).part or Part()).probability

    def last_answer(self) -> int:
        """Return the job of the last identification, until the next one begins; 0: no answer."""
        return (self._service.plugin.status().last_answer or Part()).job

    def part(self) -> int:
        """Return the number of the newest identified or sorted part; 0: none since the start."""
        return (self._service.snapshot().part or Part()).number

    def part_label(self, part: int) -> str:
        """Return the label of the part."""
        return self._service.shift.part(part).label

    def part_label_id(self, part: int) -> int:
        """Return the id of the label of the part, from 1; 0: UNKNOWN."""
        return self._service.shift.part(part).label_id

    def part_probability(self, part: int) -> float:
        """Return the probability of the label of the part, 0 to 1."""
        return self._service.shift.part(part).probability

    def part_size(self, part: int) -> float:
        """Return the size of the part in mm; 0: not measured."""
        return self._service.shift.part(part).size_mm or 0.0

    def part_place(self, part: int) -> str:
        """Return the place where a sort released the part; empty: not sorted."""
        return self._service.shift.part(part).place or ""

    def part_place_id(self, part: int) -> int:
        """Return the number of that place, from 1, rejects last; 0: not sorted."""
        return self._service.shift.part(part).place_id

    def pose_seq(self) -> int:
        """Return the number of the pose that the cell waits for; 0: none."""
        return self._service.snapshot().pose_seq

    def recording_fault(self) -> str:
        """Return why the recording has stopped; empty: no problem, or no recording."""
        return self._service.plugin.status().recording_fault or ""

    def fault_number(self) -> int:
        """Return the number of the latched fault; 0: none."""
        return self._service.plugin.status().fault_number

    def fault_text(self) -> str:
        """Return the text of the latched fault; empty: none."""
        return self._service.plugin.status().fault or ""

    def teach(self, lease: int, label: str, grasps: int, job: int = 0) -> int:
        """Start to teach an object. Return the job."""
        return self._service.request(lease, "teach", number=job, label=label, grasps=grasps)

    def identify(
        self, lease: int, max_grasps: int, force_n: float, keep: bool, job: int = 0
    ) -> int:
        """Start an identification; 0 grasps and 0 N: the values of the config. Return the job."""
        return self._service.request(
            lease, "identify", number=job, max_grasps=max_grasps, force_n=force_n, keep=keep
        )

    def grip(self, lease: int, force_n: float, job: int = 0) -> int:
        """Start to grip a part; it is kept with `force_n`, at most `carry_force_n`. Return the job.

        0 N: `carry_force_n`.
        """
        return self._service.request(lease, "grip", number=job, force_n=force_n)

    def verify(self, lease: int, job: int = 0) -> int:
        """Start to check whether the held part is still the same. Return the job."""
        return self._service.request(lease, "verify", number=job)

    def zero(self, lease: int, job: int = 0) -> int:
        """Start to measure the zero with the empty fingers closed on each other. Return the job."""
        return self._service.request(lease, "zero", number=job)

    def sort(self, lease: int, parts: int, max_grasps: int, force_n: float, job: int = 0) -> int:
        """Start to sort parts to their places; not with a callback positioner. Return the job."""
        return self._service.request(
            lease, "sort", number=job, parts=parts, max_grasps=max_grasps, force_n=force_n
        )

    def release(self, lease: int, key: int, job: int = 0) -> int:
        """Start to release the part, with key 20304 (0x4F50). Return the job."""
        return self._service.request(lease, "release", number=job, key=key)

    def clear(self, lease: int, job: int = 0, reboot: bool = False) -> int:
        """Start to acknowledge the fault; `reboot` restarts servos with a fault. Return the job."""
        return self._service.request(lease, "clear", number=job, reboot=reboot)

    def reset(self, lease: int, job: int = 0) -> int:
        """Start to verify the devices again, also after a shutdown. Return the job."""
        return self._service.request(lease, "reset", number=job)

    def shutdown(self, lease: int, job: int = 0) -> int:
        """Start to disconnect the devices; a held part stays held. Return the job."""
        return self._service.request(lease, "shutdown", number=job)


def _measured(value: float | None) -> float:
    """Return a value. Raises NotMeasured without one."""
    if value is None:
        raise NotMeasured("the value is not measured at the moment; read the state of the cell")
    return value


def ur_pose(pose: Pose | None) -> dict[str, float]:
    """Return a pose for URScript, in the grip frame: m, and a rotation vector in rad.

    The object first rolls about its long axis (x), then turns about the approach axis (z).
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


_EMPTY: Mapping[type, Any] = {str: "", dict[str, float]: ur_pose(None)}
"""Results of failed methods that return no number."""
METHODS = {
    name: method
    for name, method in vars(Calls).items()
    if inspect.isfunction(method) and name[0] != "_"
}
"""Methods of `Calls` by name."""


def methods(calls: Calls) -> dict[str, Callable[..., Any]]:
    """Return all methods by name; they never raise."""
    return {
        name: _harmless(getattr(calls, name), calls._refuse)  # noqa: SLF001  as a method
        for name in METHODS
    }


def _checked(taken: inspect.Signature, arguments: tuple[Any, ...]) -> Iterable[Any]:
    """Return the arguments, whole numbers as int: a robot may compute in floats.

    Raises ConfigError for a wrong number of arguments, or a text in place of a number.
    """
    try:
        given = taken.bind(*arguments).arguments
    except TypeError as error:
        raise ConfigError(f"{error}; the arguments are {taken}") from error
    for name, value in given.items():
        kind = taken.parameters[name].annotation
        if kind is not str and not isinstance(value, int | float):
            raise ConfigError(f"{name} is {value!r:.40}; write a number")
        if kind is int and isinstance(value, float) and value.is_integer():
            given[name] = int(value)
    return given.values()


def _harmless(call: Callable[..., Any], refuse: Callable[[Exception], int]) -> Callable[..., Any]:
    taken = inspect.signature(call)
    returned = taken.return_annotation

    @functools.wraps(call)
    def called(*arguments: Any) -> Any:
        try:
            return call(*_checked(taken, arguments))
        except Exception as error:
            if call.__name__ == Calls.hold.__name__:
                call()  # a wrong argument stops once
            number = refuse(error)
            return _EMPTY.get(returned, float(-number) if returned is float else -number)

    called.__signature__ = taken  # type: ignore[attr-defined]
    return called


class _Dispatcher(SimpleXMLRPCDispatcher):
    """Answers calls; an ASGI application."""

    async def __call__(self, scope: Scope, receive: Any, send: Send) -> None:
        """Answer a request; refuse requests that a web page could send, and compressed ones."""
        fields = {name: value.decode("latin-1").lower() for name, value in scope["headers"]}
        body, more = b"", True
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":  # an incomplete request is ignored
                return
            body += message["body"]
            more = message.get("more_body", False)
        if scope["path"] not in _PATHS:
            answer: Response = refusal(404, f"{scope['path']!r:.80} takes no calls", _REMEDY)
        elif scope["method"] != "POST":
            answer = refusal(405, f"{scope['method']} is not a call", _REMEDY)
        elif fields.get(b"content-type", "").partition(";")[0].strip() != "text/xml":
            answer = refusal(403, "the Content-Type is not text/xml", _REMEDY)
        elif (coding := fields.get(b"content-encoding", "identity")) != "identity":
            answer = refusal(501, f"Content-Encoding {coding!r:.40} is not supported", _REMEDY)
        elif (call := _decoded(body)) is None:
            answer = refusal(501, "the call is not in UTF-8, or has a DOCTYPE", _REMEDY)
        else:
            CLIENT.set(scope["client"][0])
            reply = await asyncio.to_thread(self._marshaled_dispatch, call)
            answer = Response(cast("bytes", reply), headers={"content-type": "text/xml"})
        await answer(scope, receive, send)


def _decoded(body: bytes) -> str | None:
    """Return a call as text; None in another encoding or with a document type.

    The parser takes a text as UTF-8, whatever encoding its first line names; only null bytes would
    make it UTF-16.
    """
    try:
        call = body.decode()
    except UnicodeDecodeError:
        return None
    return None if "<!" in call or "\0" in call else call


class XmlRpcInterface(HttpServer):
    """The cell behind XML-RPC.

    Raises OSError if it cannot listen at the configured address and port, or cannot read the file
    of the secret. Raises ConfigError if the secret is too short.
    """

    def __init__(self, service: Service) -> None:
        config = service.config.serve
        secret = read_secret(config.secret_file) if config.secret_file else ""
        calls = _Dispatcher(allow_none=False)
        calls.register_introspection_functions()
        for name, method in methods(Calls(service, secret)).items():
            calls.register_function(method, name)
        super().__init__(calls, config, config.xmlrpc_port or 0, idle_s=_IDLE_S)
