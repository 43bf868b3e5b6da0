"""Times of a query and a command over each interface, beside those of the plain call.

The query is the state of the cell. The command is a reset, which reaches the cell and is refused
there, because the cell is ready. Nothing moves, so only the transmission is measured. Over Modbus
it is one block and the reading of its result. The cell is the simulated one in virtual time.
The last figures are the lateness of the force loop on pseudo-terminals while parts are gripped and
released: without clients, and with four client processes that query 200 times a second each.
"""

import contextlib
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from xmlrpc.client import ServerProxy

from benchmarks._measure import in_turns, line, quantile, repeats, same
from benchmarks.performance.loop_lateness import figures, real_time_cell, running
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.states import Command
from cell.errors import CellStateError
from cell.fault_catalogue import fault_number
from cell.interfaces.opening import open_interfaces
from cell.service.opening import open_service
from cell.service.service import RELEASE_KEY, Service

_INTERFACES = {
    "serve.modbus_port": 0,
    "serve.xmlrpc_port": 0,
    "serve.http_port": 0,
    "serve.lease_timeout_s": 60.0,
}
_REFUSED = 505
"""Number of a command that the state does not allow."""
_CALLS = 200
"""Calls of one round at effort 1."""
_CLIENT = """
import sys, time
from xmlrpc.client import ServerProxy
cell = ServerProxy(sys.argv[1])
while True:
    cell.state()
    time.sleep(0.005)
"""
_GRIPS = 4
"""Grips of one run in real time."""


class Modbus:
    """A client of the bytes alone, so that no library is measured."""

    def __init__(self, port: int) -> None:
        self._link = socket.create_connection(("127.0.0.1", port))
        self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._seq = 0
        self._ask(struct.pack(">BHH", 6, 0, 1))
        self._ask(struct.pack(">BHH", 6, 8, 0))

    def state(self) -> int:
        """Return the state of the cell."""
        return self._words(3, 1)[0]

    def reset(self) -> int:
        """Ask for a reset and return its result."""
        self._seq = (self._seq + 1) & 0xFFFF
        self._ask(struct.pack(">BHHB8H", 16, 1, 8, 16, 1, 0, 0, 0, 0, 0, 0, self._seq))
        seq, result = self._words(5, 2)
        same(seq == self._seq, "Modbus has not acknowledged a command")
        return result

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    def _words(self, address: int, count: int) -> tuple[int, ...]:
        return struct.unpack(f">{count}H", self._ask(struct.pack(">BHH", 4, address, count))[2:])

    def _ask(self, request: bytes) -> bytes:
        self._link.sendall(struct.pack(">HHHB", 1, 0, len(request) + 1, 1) + request)
        found = self._link.recv(512)
        same(found[7] == request[0], "Modbus answers with an exception")
        return found[7:]


def took_s(call: Callable[[], int], expected: int, count: int) -> list[float]:
    """Return the time of each of so many calls, which must give what is expected."""
    each_s = []
    for _ in range(count):
        begin_s = time.perf_counter()
        found = call()
        each_s.append(time.perf_counter() - begin_s)
        same(found == expected, f"a call gave {found}, not {expected}")
    return each_s


def plain_reset(service: Service, lease: int) -> int:
    """Return the number of the refusal of a reset."""
    try:
        service.command(lease, Command.RESET)
    except CellStateError as error:
        return fault_number(error)
    return 0


def compare(rounds: int, count: int) -> None:
    """Print the times of query and command over both interfaces and by the plain call."""
    service = open_service(changed_config(CellConfig(), _INTERFACES))
    with contextlib.closing(service), open_interfaces(service) as interfaces:
        ready = service.status().state_number
        with ServerProxy(f"http://127.0.0.1:{interfaces['xmlrpc_port']}") as robot:
            lease = robot.acquire("benchmark")
            own: dict[str, tuple[Callable[[], int], Callable[[], int]]] = {
                "plain call": (
                    lambda: service.status().state_number,
                    lambda: plain_reset(service, lease),
                ),
                "XML-RPC": (lambda: robot.state(), lambda: -robot.reset(lease)),  # noqa: PLW0108
            }
            found = measured(own, ready, rounds, count)
            robot.give_up(lease)
        modbus = Modbus(interfaces["modbus_port"])
        found |= measured({"Modbus": (modbus.state, modbus.reset)}, ready, rounds, count)
        modbus.close()
    for what in ("question", "command"):
        plain_s = statistics.median(found["plain call", what])
        for name in ("plain call", "Modbus", "XML-RPC"):
            each_s = found[name, what]
            line(
                f"{what}, {name}",
                f"{1e3 * statistics.median(each_s):.3f} ms, p99 {1e3 * quantile(each_s, 0.99):.3f} "
                f"ms  ratio {statistics.median(each_s) / plain_s:.0f}",
            )


def measured(
    cases: dict[str, tuple[Callable[[], int], Callable[[], int]]],
    ready: int,
    rounds: int,
    count: int,
) -> dict[tuple[str, str], list[float]]:
    """Return the times of question and command of each case, taken in turns."""
    turns: dict[str, Callable[[], tuple[list[float], list[float]]]] = {
        name: lambda calls=calls: (
            took_s(calls[0], ready, count),
            took_s(calls[1], _REFUSED, count),
        )
        for name, calls in cases.items()
    }
    found: dict[tuple[str, str], list[float]] = {}
    for name, runs in in_turns(turns, rounds).items():
        for at, what in enumerate(("question", "command")):
            found[name, what] = [each_s for run in runs for each_s in run[at]]
    return found


@contextlib.contextmanager
def clients(n_clients: int, port: int) -> Iterator[None]:
    """Run clients that ask without a pause."""
    program = [sys.executable, "-c", _CLIENT, f"http://127.0.0.1:{port}"]
    with running([subprocess.Popen(program, stderr=subprocess.DEVNULL) for _ in range(n_clients)]):
        yield


def lateness(n_clients: int) -> str:
    """Grip on pseudo-terminals with so many clients; return the loop's figures."""
    with real_time_cell(**_INTERFACES) as (_, config):
        service = open_service(config)
        with contextlib.closing(service), open_interfaces(service) as interfaces:
            lease = service.lease.acquire("benchmark")
            grip = {"task": "grip", "force_n": 3.0, "present": "ball"}
            with clients(n_clients, interfaces["xmlrpc_port"]):
                for _ in range(_GRIPS):
                    wait_for(service, service.start(lease, grip))
                    release = service.command(lease, Command.RELEASE, key=RELEASE_KEY)
                    wait_for(service, release)
            hand = service._plugin._cell.controller.hand  # noqa: SLF001  its figures are no interface's
            return figures(hand.statistics.loop)


def wait_for(service: Service, number: int) -> None:
    """Wait for a job that must succeed."""
    while (job := service.job(number)).outcome_number < 4:
        time.sleep(0.01)
    same(job.outcome_number == 4, f"the job failed: {job.error}")


def main(effort: float = 1.0) -> None:
    print(
        "compared: state of the cell and a refused reset, over each interface and by a plain call"
    )
    compare(repeats(5, effort), repeats(_CALLS, effort, least=20))
    if effort < 1.0:
        return  # real time is for a machine that does nothing else
    for n_clients in (0, 4):
        line(f"force loop, {n_clients} clients", lateness(n_clients))
