"""The calls of hosts in one table: source of methods (XML-RPC) and commands (Modbus).

No method raises. A method that fails returns the negative fault number, or an empty text;
`Calls.refusal` has the reason.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from inspect import Parameter, Signature
from types import SimpleNamespace
from typing import Any, NamedTuple

from cell.errors import ConfigError, NotMeasured, RequestRefused
from cell.fault_catalogue import Refusal, for_display
from cell.interfaces.access import same_secret
from cell.interfaces.host_values import VALUES, Value, ur_pose
from cell.service.service import Service

CLIENT: ContextVar[str] = ContextVar("client", default="")
"""Address of the client of the present call; empty if not known."""
_REFUSALS_MAX = 100
"""Most clients whose last refusal is kept; the oldest refusal is dropped first."""


class HostCommand(NamedTuple):
    """A task or command that starts a job, with plain values for hosts."""

    name: str
    """Task of a goal, or command of the service."""
    fields: Mapping[str, type]
    """Its arguments, in this order; 0: the value of the config."""
    numbers: tuple[int, ...]
    """Modbus commands that start it; numbers below 20 are CntrlCmd of PackTags."""
    text: str
    """Description."""


# fmt: off
COMMANDS = (
    HostCommand("teach", {"label": str, "grasps": int}, (20,), "Start to teach an object"),
    HostCommand("identify", {"max_grasps": int, "force_n": float, "keep": bool}, (2, 21),
                "Start an identification; 0 grasps and 0 N: the values of the config"),
    HostCommand("grip", {"force_n": float}, (22,),
                "Start to grip a part and keep it, without a name"),
    HostCommand("verify", {}, (23,), "Start to check whether the held part is still the same"),
    HostCommand("zero", {}, (25,),
                "Start to measure the zero with the empty fingers closed on each other"),
    HostCommand("sort", {"parts": int, "max_grasps": int, "force_n": float}, (24,),
                "Start to identify parts and release each at its place of `sort.places`"),
    HostCommand("release", {"key": int}, (30,),
                "Start to release the part, with key 20304 (0x4F50)"),
    HostCommand("clear", {"reboot": bool}, (9,),
                "Start to acknowledge the fault; `reboot` restarts servos with a fault"),
    HostCommand("reset", {}, (1,),
                "Start to verify the devices again, also after a shutdown"),
    HostCommand("shutdown", {}, (3,),
                "Start to disconnect the devices; a held part stays held"),
)
# fmt: on
"""All commands."""


class Calls:
    """The methods for hosts; types are int, float, bool, str and pose only.

    Methods of `VALUES` and `COMMANDS` are added below. `acquire` checks the secret if it is not
    empty.
    """

    def __init__(self, service: Service, secret: str = "") -> None:
        self._service = service
        self._secret = secret
        self._refusals: dict[str, Refusal] = {}

    @property
    def refusal(self) -> Refusal:
        """Reason of the last refused call of this address."""
        return self._refusals.get(CLIENT.get(), Refusal())

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
        found = self._service.plugin.job(job)
        return for_display(found.fault_number, found.error)

    def same(self, job: int) -> int:
        """Return the result of a verification: 1 same part, 0 another or no part, -1 running."""
        found = self._service.plugin.job(job).verification
        return -1 if found is None else int(bool(found.held and found.same))

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
        return str(self.refusal)


def _reader(value: Value) -> Callable[..., Any]:
    """Return the method that reads a value of the cell, or of a job or part by its number."""
    unmeasured = "; -516 if it is not measured" if ".live." in value.source else ""

    def checked(shown: Any) -> Any:
        found = value.of(shown)
        if found is None and unmeasured:
            raise NotMeasured("the value is not measured at the moment; read the state of the cell")
        return value.kind() if found is None else found

    def of_cell(self: Calls) -> Any:
        return checked(self._service.snapshot())

    def of_job(self: Calls, job: int) -> Any:
        return checked(SimpleNamespace(job=self._service.plugin.job(job)))

    def of_part(self: Calls, part: int) -> Any:
        return checked(SimpleNamespace(part=self._service.shift.part(part)))

    of_one = {"job": of_job, "part": of_part}
    numbered = not value.source.endswith(".number")
    method: Callable[..., Any] = of_one.get(value.source.split(".")[0] * numbered, of_cell)
    method.__doc__ = f"{value.text}{unmeasured}."
    method.__annotations__["return"] = value.kind
    return method


def _starter(command: HostCommand) -> Callable[..., Any]:
    """Return the method of a command; it takes the lease, the fields and the job number."""

    def parameter(name: str, kind: type, default: Any = Parameter.empty) -> Parameter:
        return Parameter(name, Parameter.POSITIONAL_ONLY, default=default, annotation=kind)

    fields = [parameter(name, kind) for name, kind in command.fields.items() if name != "reboot"]
    last = [parameter("reboot", bool, False)] if "reboot" in command.fields else []
    taken = [parameter("lease", int), *fields, parameter("job", int, 0), *last]

    def start(self: Calls, *given: Any) -> int:
        bound = Signature(taken).bind(*given)
        bound.apply_defaults()
        lease, number = bound.arguments.pop("lease"), bound.arguments.pop("job")
        return self._service.request(lease, command.name, number=number, **bound.arguments)

    start.__doc__ = f"{command.text}. Return the job."
    start.__signature__ = Signature(  # type: ignore[attr-defined]
        [parameter("self", Calls), *taken], return_annotation=int
    )
    return start


for _value in VALUES:
    if _value.method:
        setattr(Calls, _value.method, _reader(_value))
for _command in COMMANDS:
    setattr(Calls, _command.name, _starter(_command))

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


def _check_types(taken: inspect.Signature, arguments: tuple[Any, ...]) -> None:
    """Raise ConfigError for a wrong number of arguments, or a text in place of a number."""
    try:
        given = taken.bind(*arguments).arguments
    except TypeError as error:
        raise ConfigError(f"{error}; the arguments are {taken}") from error
    for name, value in given.items():
        if taken.parameters[name].annotation is not str and not isinstance(value, int | float):
            raise ConfigError(f"{name} is {value!r:.40}; write a number")


def _harmless(call: Callable[..., Any], refuse: Callable[[Exception], int]) -> Callable[..., Any]:
    taken = inspect.signature(call)
    returned = taken.return_annotation

    @functools.wraps(call)
    def called(*arguments: Any) -> Any:
        try:
            _check_types(taken, arguments)
            return call(*arguments)
        except Exception as error:
            number = refuse(error)
            return _EMPTY.get(returned, float(-number) if returned is float else -number)

    called.__signature__ = taken  # type: ignore[attr-defined]
    return called
