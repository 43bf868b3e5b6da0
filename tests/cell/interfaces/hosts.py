"""Hosts of the interfaces as others write them, and what the contract asks of each of them."""

import json
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPConnection
from typing import Any, NamedTuple
from xmlrpc.client import ServerProxy

from pymodbus.client import ModbusTcpClient
from websockets.sync.client import connect as open_socket

from cell.control.plan import Keep
from cell.interfaces.modbus.registers import COMMAND, COMMAND_SEQ, HOLD, LIFE, REBOOT
from tests import ROOT
from tests.waiting import LIMIT_S, until

# -- clients -----------------------------------------------------------------------------------


class Plc:
    """A PLC that writes single registers or blocks, and follows the handshake."""

    def __init__(self, port: int) -> None:
        self.link = ModbusTcpClient("127.0.0.1", port=port, timeout=LIMIT_S, retries=0)
        assert self.link.connect()
        self.life = 0
        self.seq = 0

    def inputs(self) -> list[int]:
        return self.link.read_input_registers(0, count=96).registers

    def part(self) -> list[int]:
        """Return the registers of the newest part."""
        return self.link.read_input_registers(96, count=40).registers

    def refusal(self) -> tuple[int, str]:
        """Return number and text of the last refusal of this connection."""
        inputs = self.inputs()
        return inputs[26], struct.pack(">32H", *inputs[64:]).rstrip(b"\0").decode("ascii")

    def write(self, address: int, *values: int) -> int:
        """Write registers and return the exception code; 0 for none."""
        answer = self.link.write_registers(address, list(values))
        return answer.exception_code if answer.isError() else 0

    def live(self) -> int:
        self.life = (self.life + 1) & 0xFFFF
        return self.write(LIFE, self.life)

    def adopt(self) -> "Plc":
        """Take the lease and the acknowledged number."""
        self.life = self.link.read_holding_registers(0, count=1).registers[0]
        assert self.live() == 0
        self.seq = self.inputs()[5]
        assert self.write(COMMAND_SEQ, self.seq) == 0
        return self

    def command(self, number: int, *arguments: int) -> int:
        """Run a command and return its result; arguments are registers 2 to 6."""
        self.seq = (self.seq + 1) & 0xFFFF
        values = [number, *arguments, *[0] * (6 - len(arguments)), self.seq]
        assert self.write(COMMAND, *values) == 0
        inputs = self.inputs()
        assert inputs[5] == self.seq
        return inputs[6]


class BlockPlc:
    """A PLC whose program is the block of the example: one exchange with the cell each cycle."""

    def __init__(self, plc: Plc) -> None:
        self.plc = plc
        self.block = FunctionBlock()
        self.connected = True

    def __getitem__(self, name: str) -> Any:
        return self.block[name]

    def cycle(self, **inputs: Any) -> "BlockPlc":
        """Read, call the block, write; an exception as answer is no success."""
        wanted = {"Enable": True, "Connected": self.connected, "Execute": False, "HoldNow": False}
        blocks = {"Inputs": self.plc.inputs()[:64], "Part": self.plc.part()}
        self.connected = self.plc.write(0, *self.block.call(**(blocks | wanted | inputs))) == 0
        return self

    def ready(self) -> "BlockPlc":
        until(lambda: self.cycle()["Ready"] and not self["Busy"])
        return self

    def begin(self, command: int, **inputs: Any) -> "BlockPlc":
        """Give Execute an edge; return when the cell has answered."""
        arguments = {"Command": command, "Object": 0, "Force": 0, "MaxGrasps": 0, "Options": 0}
        self.cycle(Execute=True, **arguments | inputs)
        until(lambda: self.cycle()["Accepted"] or self["Error"])
        return self

    def run(self, command: int, **inputs: Any) -> tuple[bool, int]:
        """Run a command to its end; return Done and ErrorId."""
        self.ready().begin(command, **inputs)
        until(lambda: not self.cycle()["Busy"])
        assert self["Done"] is not self["Error"]
        return self["Done"], self["ErrorId"]


class Client:
    """A host with the token; each request has its own connection; the interface ends idle ones."""

    def __init__(self, interfaces: dict[str, Any]) -> None:
        self.port = interfaces["http_port"]
        self.token = interfaces["token"]

    def send(
        self, method: str, path: str, data: Any = None, *, token: str | None = "", **headers: str
    ) -> tuple[int, Any, str]:
        """Return status, answer and its type; a JSON answer as what it is."""
        link = HTTPConnection("127.0.0.1", self.port, timeout=LIMIT_S)
        if token is not None:
            headers["Authorization"] = f"Bearer {token or self.token}"
        link.request(method, path, data, headers)
        answer = link.getresponse()
        body, kind = answer.read(), answer.getheader("Content-Type", "")
        link.close()
        return answer.status, json.loads(body) if "json" in kind else body, kind

    def ask(self, method: str, path: str, body: Any = None, **more: Any) -> tuple[int, Any]:
        """Return status and answer to a request with JSON."""
        data = None if body is None else json.dumps(body)
        return self.send(method, path, data, **{"Content-Type": "application/json"} | more)[:2]

    def get(self, path: str) -> Any:
        status, answer = self.ask("GET", path)
        assert status == 200, answer
        return answer

    def post(self, path: str, **body: Any) -> Any:
        status, answer = self.ask("POST", path, body)
        assert status == 200, answer
        return answer

    def live(self, query: str = "", **more: Any) -> Any:
        return open_socket(f"ws://127.0.0.1:{self.port}/api/live?token={self.token}{query}", **more)


# -- hosts -------------------------------------------------------------------------------------

NOT_IN_COMMAND = 514
"""Fault number of a request of a client without the lease."""
TASKS = ("identify", "grip", "verify", "release", "clear", "reset", "shutdown", "teach")
_CODES = dict(zip(TASKS, (21, 22, 23, 30, 9, 1, 3, 20), strict=True))
_KEEP_BITS = {Keep.NEVER: 0, Keep.ALWAYS: 1, Keep.WHEN_NAMED: 2}


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A command as a client sends it."""

    task: str
    """One of `TASKS`."""
    force_n: float = 0.0
    max_grasps: int = 0
    keep: Keep = Keep.NEVER
    """Of an identification; the force of a grip too; of a teaching the number of grasps."""
    key: int = 0
    """Of a release."""
    reboot: bool = False
    """Of a clear."""
    label: str = ""
    """Of a teaching."""


class Place(NamedTuple):
    """Where an interface shows a value; empty where it has it not."""

    method: str
    """Method of XML-RPC, and the method or value whose number it takes."""
    register: str
    """Input register of Modbus with its bit."""
    path: str
    """Path in the state of HTTP."""
    unit: float = 1
    """Of the register."""


# fmt: off
VALUE_PLACES = {
    "state": Place("state", "3", "status.state_number"),
    "needs_reset": Place("needs_reset", "2.10", "status.needs_reset"),
    "on_hold": Place("held_by", "2.11", "held_by"),
    "grip": Place("grip_state", "4", "status.grasp_number"),
    "holding": Place("holding", "2.6", "status.holding"),
    "force_n": Place("force", "13", "live.force_n", 0.01),
    "force_age_s": Place("force_age", "23", "live.force_age_s", 1e-3),
    "setpoint_n": Place("", "", "live.setpoint_n"),
    "opening_mm": Place("opening", "14", "live.opening_mm", 0.01),
    "temperature_c": Place("", "22", "live.temperature_c"),
    "frame_age_s": Place("frame_age", "21", "live.frame_age_s", 1e-3),
    "fault": Place("fault_number", "", "status.fault_number"),
    "recording": Place("recording_fault", "2.12", ""),
    "job": Place("", "8", "job.number"),
    "outcome": Place("job_state job", "9", "job.outcome_number"),
    "job_fault": Place("job_fault job", "", "job.fault_number"),
    "n_grasps": Place("", "12", "job.part.n_grasps"),
    "answer_job": Place("last_answer", "24", "last_answer.job"),
    "label": Place("label last_answer", "", "last_answer.label"),
    "label_id": Place(
        "label_id last_answer", "10", "last_answer.label_id"),
    "probability": Place(
        "probability last_answer", "11", "last_answer.probability", 1e-4),
    "size_mm": Place("part_size part", "15", "last_answer.size_mm", 0.01),
    "in_grip": Place("", "25.2", "last_answer.in_grip"),
    "part": Place("part", "96", "part.number"),
    "part_label_id": Place("part_label_id part", "97", "part.label_id"),
    "pose_seq": Place("pose_seq", "16", "pose_seq"),
}
# fmt: on
"""What all interfaces show, by our name for it."""


class ModbusHost(Plc):
    """A PLC; a request is one block of registers with its sequence number at the end."""

    name = "Modbus 127.0.0.1"
    """As the cell shows who holds."""

    def __init__(self, interfaces: dict[str, Any]) -> None:
        super().__init__(interfaces["modbus_port"])
        self._panel = Plc(interfaces["modbus_port"])
        self._block: list[int] = []

    def acquire(self) -> int:
        """Take command and return 0, or the fault number of the refusal."""
        if self.live():
            return self.refusal()[0]
        self.adopt()
        return 0

    def send(self, request: Request, number: int) -> int:
        """Send a request for the job of that number; return it, or a fault number, negative."""
        options = _KEEP_BITS[request.keep] | (REBOOT if request.reboot else 0)
        force, code = round(100 * request.force_n), _CODES[request.task]
        object_id = ("", "ball", "box").index(request.label)
        return self._run(code, object_id, force, request.max_grasps, options, request.key)

    def _run(self, *registers: int) -> int:
        self.seq = (self.seq + 1) & 0xFFFF
        self._block = [*registers, *[0] * (7 - len(registers)), self.seq]
        return self.repeat()

    def repeat(self) -> int:
        """Send the last request once more; return as `send`."""
        if self.write(COMMAND, *self._block):
            return -NOT_IN_COMMAND
        inputs = self.inputs()
        return -inputs[6] if inputs[6] else inputs[8]

    def hold(self, latch: bool | None = None) -> None:
        """Hold without the lease: once, or begin or end it."""
        for pressed in (True, False) if latch is None else (latch,):
            self._panel.write(HOLD, int(pressed))

    def reached(self, seq: int, *, ok: bool) -> int:
        """Answer a pose; return 0, or a fault number, negative."""
        return min(0, self._run(40 if ok else 41, seq))

    def values(self) -> dict[str, Any]:
        """Return what the interface shows, by the names of `VALUE_PLACES`; None: not measured."""
        inputs = self.inputs() + self.part()
        values: dict[str, Any] = {"fault": inputs[7] if inputs[2] & 32 else 0}
        for name, place in VALUE_PLACES.items():
            register, _, bit = place.register.partition(".")
            if bit:
                values[name] = bool(inputs[int(register)] >> int(bit) & 1)
            elif register:
                measured = inputs[int(register)] not in (0x7FFF, 0x8000)
                values[name] = inputs[int(register)] * place.unit if measured else None
        return values

    def close(self) -> None:
        self.link.close()
        self._panel.link.close()


class XmlRpcHost:
    """A robot program; it keeps a part always or never."""

    name = "XML-RPC 127.0.0.1 panel"

    def __init__(self, interfaces: dict[str, Any]) -> None:
        self._cell: Any = ServerProxy(f"http://127.0.0.1:{interfaces['xmlrpc_port']}/RPC2")
        self.lease = 0
        self._last: tuple[Any, ...] = ()

    def call(self, method: str, *arguments: Any) -> Any:
        return getattr(self._cell, method)(*arguments)

    def acquire(self) -> int:
        lease = int(self.call("acquire", "host"))
        self.lease = lease if lease > 0 else self.lease
        return max(0, -lease)

    def send(self, request: Request, number: int) -> int:
        arguments: dict[str, tuple[Any, ...]] = {
            "identify": (request.max_grasps, request.force_n, request.keep is not Keep.NEVER),
            "grip": (request.force_n,),
            "release": (request.key,),
            "teach": (request.label, request.max_grasps),
        }
        reboot = (request.reboot,) if request.task == "clear" else ()
        given = (*arguments.get(request.task, ()), number, *reboot)
        self._last = request.task, self.lease, *given
        return self.repeat()

    def repeat(self) -> int:
        return int(self.call(*self._last))

    def hold(self, latch: bool | None = None) -> None:
        assert self.call("hold", -1 if latch is None else int(latch), "panel") == 0

    def reached(self, seq: int, *, ok: bool) -> int:
        return int(self.call("pose_reached", self.lease, seq, ok))

    def values(self) -> dict[str, Any]:
        values: dict[str, Any] = {"job": self._cell.next_job() - 1}
        for name, place in VALUE_PLACES.items():
            method, _, of = place.method.partition(" ")
            numbers = [values[of] if of == "job" else self.call(of)] if of else []
            if method and all(numbers):
                value = self.call(method, *numbers)
                values[name] = None if value == -516 else value
        return values

    def refusal(self) -> tuple[int, str]:
        number, _, text = self._cell.last_refusal().partition(": ")
        return int(number or 0), text

    def close(self) -> None:
        self._cell("close")()


class HttpHost:
    """A host with the token."""

    name = "HTTP 127.0.0.1 panel"

    def __init__(self, interfaces: dict[str, Any]) -> None:
        self._host = Client(interfaces)
        self.lease = 0
        self._last: tuple[str, dict[str, Any]] = ("", {})
        self._refusal = 0, ""

    def _post(self, path: str, **body: Any) -> int:
        """Return 0 or the number of the job; of a refusal its number, negative."""
        _, answer = self._host.ask("POST", path, body)
        if "fault_number" in answer:
            self._refusal = answer["fault_number"], f"{answer['error']} {answer['remedy']}"
            return -int(answer["fault_number"])
        self.lease = answer.get("lease", self.lease)
        return int(answer.get("job", 0))

    def acquire(self) -> int:
        return -self._post("/api/lease", name="host")

    def send(self, request: Request, number: int) -> int:
        body: dict[str, Any] = {"lease": self.lease, "job": number}
        goals: dict[str, dict[str, Any]] = {
            "identify": {"keep": request.keep.value, "force_n": request.force_n},
            "grip": {"force_n": request.force_n},
            "verify": {},
            "teach": {"label": request.label, "grasps": request.max_grasps},
        }
        if request.task == "identify" and request.max_grasps:
            goals["identify"]["max_grasps"] = request.max_grasps
        if request.task in goals:
            goal = {"task": request.task} | goals[request.task]
            self._last = "/api/jobs", body | {"goal": goal}
        else:
            given = {"command": request.task, "key": request.key, "reboot": request.reboot}
            self._last = "/api/commands", body | given
        return self.repeat()

    def repeat(self) -> int:
        path, body = self._last
        return self._post(path, **body)

    def hold(self, latch: bool | None = None) -> None:
        query = "" if latch is None else f"&latch={latch}"
        assert self._host.ask("POST", f"/api/hold?name=panel{query}", token=None)[0] == 200

    def reached(self, seq: int, *, ok: bool) -> int:
        return self._post("/api/pose", lease=self.lease, seq=seq, ok=ok)

    def values(self) -> dict[str, Any]:
        state = self._host.get("/api/state")
        state["part"] = next(iter(state["shift"]["answers"][-1:]), None)
        values = {}
        for name, place in VALUE_PLACES.items():
            if place.path:
                value: Any = state
                for key in place.path.split("."):
                    value = None if value is None else value[key]
                values[name] = value
        return values

    def refusal(self) -> tuple[int, str]:
        return self._refusal

    def close(self) -> None: ...


Host = ModbusHost | XmlRpcHost | HttpHost
"""All with the methods of `ModbusHost`."""
HOSTS: dict[str, Callable[[dict[str, Any]], Host]] = {
    "modbus": ModbusHost,
    "xmlrpc": XmlRpcHost,
    "http": HttpHost,
}
"""The host of each interface."""


# -- the function block of the example: its Structured Text, line by line, as Python -------------


BLOCK = ROOT / "docs" / "examples" / "tactile_cell.st"


class Uint(int):
    """A UINT: a number, and no string of bits."""

    def __and__(self, other: object) -> Any:
        raise TypeError("AND of a UINT: strict compilers take BOOL and bit strings alone")


class Word(int):
    """A WORD: a string of bits, compared with its like alone."""

    def __and__(self, other: object) -> "Word":
        assert isinstance(other, Word), other
        return Word(int(self) & int(other))

    def __ne__(self, other: object) -> bool:
        assert isinstance(other, Word), other
        return int(self) != int(other)

    __hash__ = None  # type: ignore[assignment]


_TYPES: dict[str, type] = {"BOOL": bool, "UINT": int, "WORD": Word}


_PYTHON = (
    (r"\bCASE (\w+) OF", r"match \1:"),
    (r"^( +)(\d+):\s*", r"\1case \2:\n\1    "),
    (r"\bIF (.*) THEN", r"if \1:"),
    (r"\bELSE\b", "else:"),
    (r"^ *END_(IF|CASE);\n", ""),
    (r"EdgeExecute\(.*\)", "edge()"),
    (r"AND WORD#", "& WORD#"),
    (r"UINT_TO_WORD\(", "Word("),
    (r"WORD#16#(\w+)", r"Word(0x\1)"),
    (r"16#(\w+)", r"0x\1"),
    (r"(?<![<>:])=", "=="),
    (r"<>", "!="),
    (r":=", "="),
    (r";", ""),
    (r"\b(AND|OR|NOT)\b", lambda match: match[1].lower()),
    (r"\b(TRUE|FALSE)\b", lambda match: match[1].title()),
)
"""Expressions of Structured Text, in this order, and what they are in Python.

The block is indented as Python is; what is not in this table is no Python.
"""


class FunctionBlock:
    """The block as a PLC holds it: call it once a cycle; variables by name."""

    def __init__(self) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", BLOCK.read_text(), flags=re.S)
        head, body = text.split("VAR_INPUT", 1)[1].rsplit("END_VAR", 1)
        self.values: dict[str, Any] = {"EdgeExecute.Q": False}
        self._types: dict[str, type] = {}
        self._sizes: dict[str, int] = {}
        for name, kind in re.findall(r"(\w+)\s*:\s*([^;]+);", head):
            size = re.match(r"ARRAY\[0\.\.(\d+)\]", kind)
            if size:
                self._sizes[name] = int(size[1]) + 1
                self.values[name] = [0] * self._sizes[name]
            elif kind in _TYPES:
                self._types[name] = _TYPES[kind]
                self.values[name] = _TYPES[kind]()
        self._last = False
        text = body.split("END_FUNCTION_BLOCK")[0]
        for expression, python in _PYTHON:
            text = re.sub(expression, python, text, flags=re.MULTILINE)
        self._code = compile(re.sub(r"[A-Z][\w.]*", self._variable, text), str(BLOCK), "exec")

    def _variable(self, match: re.Match[str]) -> str:
        return f"me[{match[0]!r}]" if match[0] in self.values else match[0]

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def call(self, **inputs: Any) -> list[int]:
        """Run one cycle and return what it writes."""
        unknown = set(inputs) - set(self.values)
        assert not unknown, unknown
        self.values |= inputs
        for name in ("Inputs", "Part"):
            self.values[name] = [Uint(value) for value in self.values[name]]
            assert len(self.values[name]) == self._sizes[name], name
        exec(self._code, {"me": self.values, "edge": self._edge, "Word": Word})
        for name, kind in self._types.items():
            assert isinstance(self.values[name], kind), name
            assert isinstance(self.values[name], bool) is (kind is bool), name
            assert 0 <= self.values[name] <= 0xFFFF, name
        assert all(0 <= value <= 0xFFFF for value in self.values["Outputs"])
        return list(self.values["Outputs"])

    def _edge(self) -> None:
        now = self.values["Execute"]
        self.values["EdgeExecute.Q"] = now and not self._last
        self._last = now
