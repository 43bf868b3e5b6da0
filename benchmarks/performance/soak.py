"""Long runs in virtual time, in which memory stays flat and files and threads stay few.

    python -m benchmarks.performance.soak [--connects N] [--hours H] [--starts N]

`make soak` runs all three, each in a process of its own:

- connections to each interface of a service that holds a part. Most clients connect and go; some
  send half a request first, some a whole one and read its answer;
- hours of a shift, one sorted part for each 30 s, while a client of another process reads the
  stream and connects again and again;
- starts of the service in one folder. In each it sorts parts, and a person clears a fault.

Prints how memory, objects, files and threads grew, and ends with an error where they grow faster
than allowed. The first fifth of the samples is left out: caches fill then.
"""

import argparse
import gc
import os
import socket
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from xmlrpc.client import dumps

from scipy.stats import theilslopes
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks._measure import line
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.states import Command
from cell.interfaces.opening import open_interfaces
from cell.runtime.worker import Job
from cell.service.service import RELEASE_KEY, Service, open_service

USUAL: dict[str, float] = {"connects": 10_000, "hours": 8.0, "starts": 42}
LIMITS = {
    "connects": {"rss_kib": 0.1, "objects": 0.01, "descriptors": 0.001, "threads": 0.001},
    "hours": {"rss_kib": 2.0, "objects": 0.5, "descriptors": 0.001, "threads": 0.001},
    "starts": {"rss_kib": 200.0, "objects": 100.0, "descriptors": 0.005, "threads": 0.005},
}
"""Growth allowed for each connection to all interfaces, part of a shift, and start."""
REST_S = 6.0
"""Time in s before a look: uvicorn keeps the timer of a connection that has ended for 5 s."""
_SAMPLES, _WARM_UP = 24, 0.2
"""Looks at the process, and the share of them that is left out."""
_PART_S, _PARTS, _TAUGHT = 30.0, 10, 6
"""Time in s for each part of a shift, parts of each start, and grasps that teach an object."""
_PATIENCE_S, _JOB_S, _VISIT_S = 20.0, 120.0, 5.0
"""Longest wait in s for an interface and for a job, and for how long a client reads the stream."""

ResourceUse = Mapping[str, float]
"""How much was ``done``, and what the process uses then, by the names in `LIMITS`."""


def look(done: int) -> ResourceUse:
    """Collect garbage and measure this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return {
        "done": done,
        "rss_kib": pages * os.sysconf("SC_PAGE_SIZE") / 1024,
        "objects": len(gc.get_objects()),
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
    }


def judge(samples: Sequence[ResourceUse], limits: Mapping[str, float]) -> list[str]:
    """Print what grew after the warm-up; return what grows faster than its limit.

    The slope is the median over all pairs (Theil and Sen), which single steps of the allocator do
    not change.
    """
    warm = samples[int(_WARM_UP * len(samples)) :]
    bad = []
    for name, limit in limits.items():
        values = [sample[name] for sample in warm]
        slope = float(theilslopes(values, [sample["done"] for sample in warm]).slope)
        text = f"{name} grow by {slope:.4f} each, allowed are {limit:g}"
        line("", f"{text}: {values[0]:.0f} to {values[-1]:.0f}, {max(values):.0f} at most")
        bad += [text] if slope > limit else []
    return bad


def _service(**options: Any) -> Service:
    ports = {f"serve.{name}_port": 0 for name in ("modbus", "xmlrpc", "http")}
    half_a_day_off = [(time.localtime().tm_hour + 12) % 24]  # no shift begins meanwhile
    serve = {"serve.lease_timeout_s": 60.0, "serve.shift_begins_h": half_a_day_off}
    return open_service(changed_config(CellConfig(), ports | serve), **options)


def _ended(service: Service, lease: int, number: int) -> Job:
    end_s = time.monotonic() + _JOB_S
    while (job := service.plugin.job(number)).outcome in ("ACCEPTED", "EXECUTING"):
        if time.monotonic() > end_s:
            raise SystemExit(f"{job.task} is not over after {_JOB_S:g} s")
        service.lease.alive(lease)
        time.sleep(0.002)
    return job


def _run(service: Service, lease: int, **goal: Any) -> Job:
    """Run a job to its end. SystemExit where it does not succeed."""
    job = _ended(service, lease, service.start(lease, goal))
    if job.outcome != "SUCCEEDED":
        raise SystemExit(f"{goal}: {job.error}")
    return job


def _teach(service: Service) -> tuple[int, list[str]]:
    """Teach all objects; return the lease and the labels."""
    lease = service.lease.acquire("soak")
    labels = [entry.label for entry in service.config.simulator.objects]
    for seed, label in enumerate(labels):
        _run(service, lease, task="teach", label=label, grasps=_TAUGHT, seed=seed)
    return lease, labels


def ask(port: int, request: bytes, *, answer: bool = True) -> bool:
    """Send a request, or a part of it, to an interface; return whether an answer came."""
    address = "127.0.0.1", port
    with suppress(OSError), socket.create_connection(address, timeout=_PATIENCE_S) as link:
        link.sendall(request)
        return answer and bool(link.recv(100))
    return False


def connects(n: int) -> list[ResourceUse]:
    """Connect ``n`` times to each interface of a service that holds a part."""
    call, samples = dumps((), "state"), []
    with closing(_service()) as service, open_interfaces(service) as interfaces:
        head = "HTTP/1.1\r\nHost: localhost\r\n"
        token = f"Authorization: Bearer {interfaces['token']}"
        body = f"Content-Type: text/xml\r\nContent-Length: {len(call)}\r\n\r\n{call}"
        requests = {
            interfaces["modbus_port"]: bytes.fromhex("000100000006010400000001"),
            interfaces["xmlrpc_port"]: f"POST /RPC2 {head}{body}".encode(),
            interfaces["http_port"]: f"GET /api/info {head}{token}\r\n\r\n".encode(),
        }
        if not _run(service, service.lease.acquire("soak"), task="grip", force_n=3.0).verification:
            raise SystemExit("nothing was gripped")
        for number in range(1, n + 1):
            for port, request in requests.items():
                n_bytes = {3: 1 + number % (len(request) - 1), 4: len(request)}.get(number % 5, 0)
                ask(port, request[:n_bytes], answer=n_bytes == len(request))
            if number % max(1, n // _SAMPLES) == 0:
                time.sleep(REST_S)
                if not all(ask(port, request) for port, request in requests.items()):
                    raise SystemExit(f"an interface gives no answer after {number} connections")
                if not service.plugin.status().holding:
                    raise SystemExit(f"the part is not held any more: {service.plugin.status()}")
                samples.append(look(number))
    return samples


def watch(address: str, count: Any) -> None:
    """Read the stream, connect again after some time, and count messages until it is ended."""
    while True:
        end_s = time.monotonic() + _VISIT_S
        with suppress(OSError, WebSocketException), connect(address, ping_interval=None) as link:
            while time.monotonic() < end_s:
                link.recv(_JOB_S)
                count.value += 1


def hours(n: float) -> list[ResourceUse]:
    """Sort the parts of a shift of ``n`` hours without its pauses, watched by a client."""
    n_parts, samples, processes = round(3600.0 * n / _PART_S), [], get_context("spawn")
    with closing(_service()) as service, open_interfaces(service) as interfaces:
        host = f"ws://127.0.0.1:{interfaces['http_port']}"
        address = f"{host}/api/live?token={interfaces['token']}&frames=1"
        count = processes.Value("q")
        client = processes.Process(target=watch, args=(address, count), daemon=True)
        client.start()
        try:
            lease, labels = _teach(service)
            for done in range(1, n_parts + 1):
                feed = [labels[done % len(labels)]]
                _run(service, lease, task="sort", parts=1, feed=feed, seed=1000 + done)
                if done % max(1, n_parts // _SAMPLES) == 0:
                    samples.append(look(done))
        finally:
            client.kill()
        if not count.value:
            raise SystemExit("the client got no message")
    return samples


def starts(n: int) -> list[ResourceUse]:
    """Start the service ``n`` times in one folder; its shift goes on."""
    samples = []
    with tempfile.TemporaryDirectory() as name:
        model = Path(name, "parts.npz")
        for number in range(n + 1):
            folder = Path(name, f"{number:05}")
            folder.mkdir()
            with_model: dict[str, Any] = {"model" if number else "save": model}
            with closing(_service(folder=folder, **with_model)) as service:
                if not number:
                    _teach(service)
                    continue
                lease = service.lease.acquire("soak")
                _run(service, lease, task="sort", parts=_PARTS, seed=number)
                service.plugin.simulate({"inject": "unit.off"})
                goal = {"task": "grip", "force_n": 3.0}
                if not _ended(service, lease, service.start(lease, goal)).fault_number:
                    raise SystemExit("a control unit without power was no fault")
                service.plugin.simulate({"clear": "unit.off"})
                for command in (Command.CLEAR, Command.RELEASE, Command.RESET):
                    _ended(service, lease, service.command(lease, command, key=RELEASE_KEY))
                shift = service.shift.values()
                if (shift["parts"] + shift["missed"], shift["faults"]) != (_PARTS * number, number):
                    raise SystemExit(f"the shift lost parts or faults at start {number}: {shift}")
            samples.append(look(number))
    return samples


WORK: dict[str, Callable[[Any], list[ResourceUse]]] = {
    "connects": connects,
    "hours": hours,
    "starts": starts,
}


def main(effort: float = 1.0, **wanted: float) -> None:
    """Run what is wanted, by the names in `USUAL`; without, all of it."""
    bad = []
    line("compared", "the process in the course of a long run")
    for what, n in (wanted or {name: effort * n for name, n in USUAL.items()}).items():
        start_s = time.monotonic()
        samples = WORK[what](n if what == "hours" else round(n))
        line(what, f"{samples[-1]['done']:.0f} in {time.monotonic() - start_s:.0f} s")
        bad += [f"{what}: {text}" for text in judge(samples, LIMITS[what])]
    if bad:
        raise SystemExit("; ".join(bad))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    for option in USUAL:
        parser.add_argument(f"--{option}", type=float)
    main(**{name: n for name, n in vars(parser.parse_args()).items() if n is not None})
