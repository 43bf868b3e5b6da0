"""Hosts of the interfaces as others write them: a PLC with pymodbus, a program with http.client."""

import json
import struct
from http.client import HTTPConnection
from typing import Any

from pymodbus.client import ModbusTcpClient
from websockets.sync.client import connect as open_socket

from cell.interfaces.modbus.registers import COMMAND, COMMAND_SEQ, LIFE
from tests.cell.interfaces.modbus.structured_text import FunctionBlock
from tests.cell.served import LIMIT_S, until


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
        found = self.link.write_registers(address, list(values))
        return found.exception_code if found.isError() else 0

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


_PART = ("Number", "LabelId", "Probability", "Size", "Place")


def _texts(part: list[int]) -> dict[str, str]:
    """Return the names of label and place in the registers of a part."""
    found = struct.pack(">32H", *part[8:])
    return {
        "Label": found[:32].rstrip(b"\0").decode("ascii"),
        "PlaceName": found[32:].rstrip(b"\0").decode("ascii"),
    }


class BlockPlc:
    """A PLC whose program is the block of the example: one exchange with the cell each cycle."""

    def __init__(self, plc: Plc) -> None:
        self.plc = plc
        self.block = FunctionBlock()
        self.connected = True
        self.parts: list[dict[str, Any]] = []
        """Each part at which the block has shown a new one."""

    def __getitem__(self, name: str) -> Any:
        return self.block[name]

    def cycle(self, **inputs: Any) -> "BlockPlc":
        """Read, call the block, write; an exception as answer is no success."""
        wanted = {"Enable": True, "Connected": self.connected, "Execute": False, "HoldNow": False}
        blocks = {"Inputs": self.plc.inputs()[:64], "Part": self.plc.part()}
        written = self.block.call(**(blocks | wanted | inputs))
        self.connected = self.plc.write(0, *written) == 0
        if self["NewPart"]:
            self.parts.append(
                {name: self[f"Part{name}"] for name in _PART} | _texts(blocks["Part"])
            )
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
        found, kind = answer.read(), answer.getheader("Content-Type", "")
        link.close()
        return answer.status, json.loads(found) if "json" in kind else found, kind

    def ask(self, method: str, path: str, body: Any = None, **more: Any) -> tuple[int, Any]:
        """Return status and answer to a request with JSON."""
        data = None if body is None else json.dumps(body)
        return self.send(method, path, data, **{"Content-Type": "application/json"} | more)[:2]

    def get(self, path: str) -> Any:
        status, found = self.ask("GET", path)
        assert status == 200, found
        return found

    def post(self, path: str, **body: Any) -> Any:
        status, found = self.ask("POST", path, body)
        assert status == 200, found
        return found

    def live(self, query: str = "", **options: Any) -> Any:
        return open_socket(
            f"ws://127.0.0.1:{self.port}/api/live?token={self.token}{query}", **options
        )
