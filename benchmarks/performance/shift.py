"""A shift of eight hours without pauses: parts are sorted while clients watch; memory stays flat.

    python -m benchmarks.performance.shift [--hours H]        (make soak)

One service on the simulated cell sorts the parts of a shift, one part for each 30 s of it, but
without the pauses in between. Meanwhile clients of another process read its live stream: newtons,
counts, or the state alone. One client takes a message a second, and one connects again and again.
After each block of parts memory, files and threads of the service are measured, as in the soak of
grasps.
"""

import argparse
import multiprocessing
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from multiprocessing.sharedctypes import Synchronized
from threading import Thread
from typing import Any

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks._measure import line
from benchmarks.performance.connects import settle
from benchmarks.performance.soak import ResourceUse, look, show_growth
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.interfaces.opening import open_interfaces
from cell.service.opening import open_service
from cell.service.service import JobView, Service

PART_S = 30.0
"""Time in s from one part of the shift to the next."""
LIMITS = {"rss_kib": 2.0, "objects": 0.5, "descriptors": 0.001, "threads": 0.001}
"""Growth allowed for each part."""
_TAUGHT = 6
"""Grasps taught of each object."""
_BLOCKS = 24
"""Looks at the process."""
_JOB_S = 120.0
"""Longest time of a job in s of this machine."""
_CLIENTS = (("frames=newtons", 0.0), ("frames=1", 0.0), ("", 0.0), ("frames=newtons", 1.0))
"""Query of each client, and its pause in s after each message."""
_VISIT_S = 5.0
"""Time in s that the client stays that comes and goes."""


def watch(address: str, counts: "Sequence[Synchronized[int]]") -> None:
    """Read the live stream with each client, until the process is ended."""

    def read(query: str, pause_s: float, count: "Synchronized[int]", visit_s: float) -> None:
        while True:
            end_s = time.monotonic() + visit_s
            with (
                suppress(OSError, WebSocketException),
                connect(f"{address}&{query}", ping_interval=None) as link,
            ):
                while time.monotonic() < end_s:
                    link.recv(_JOB_S)
                    count.value += 1
                    time.sleep(pause_s)

    for number, (query, pause_s) in enumerate(_CLIENTS):
        far_s = 1e9
        Thread(target=read, args=(query, pause_s, counts[number], far_s), daemon=True).start()
    read("frames=newtons", 0.0, counts[-1], _VISIT_S)


def wait(service: Service, lease: int, number: int) -> JobView:
    """Return a job that has ended. SystemExit where it takes too long."""
    end_s = time.monotonic() + _JOB_S
    while (job := service.job(number)).outcome in ("ACCEPTED", "EXECUTING"):
        if time.monotonic() > end_s:
            raise SystemExit(f"{job.task} is not over after {_JOB_S:g} s")
        service.lease.alive(lease)
        time.sleep(0.002)
    return job


def run_job(service: Service, lease: int, goal: Mapping[str, Any]) -> None:
    """Run a job to its end. SystemExit where it does not succeed."""
    job = wait(service, lease, service.start(lease, goal))
    if job.outcome != "SUCCEEDED":
        raise SystemExit(f"{goal}: {job.error}")


def sort_shift(service: Service, n_parts: int) -> Iterator[ResourceUse]:
    """Teach the objects, sort the parts, and yield a sample after each block of them."""
    lease = service.lease.acquire("shift")
    labels = [entry.label for entry in service.config.simulator.objects]
    for seed, label in enumerate(labels):
        run_job(service, lease, {"task": "teach", "label": label, "grasps": _TAUGHT, "seed": seed})
    block = max(1, n_parts // _BLOCKS)
    for done in range(1, n_parts + 1):
        feed = [labels[done % len(labels)]]
        run_job(service, lease, {"task": "sort", "parts": 1, "feed": feed, "seed": 1000 + done})
        if done % block == 0:
            yield look(done, done * PART_S)


def condensed(
    hours: float, config: CellConfig
) -> tuple[list[ResourceUse], list[int], dict[str, Any]]:
    """Return the samples of a shift, the messages of each client, and the ledger of the shift."""
    ports = {"modbus": None, "xmlrpc": None, "http": 0}
    wanted: dict[str, Any] = {f"serve.{name}_port": port for name, port in ports.items()}
    service = open_service(changed_config(config, wanted | {"serve.lease_timeout_s": 60.0}))
    with closing(service), open_interfaces(service) as found:
        address = f"ws://127.0.0.1:{found['http_port']}/api/live?token={found['token']}"
        processes = multiprocessing.get_context("spawn")
        counts = [processes.Value("q") for _ in (*_CLIENTS, "the one that comes and goes")]
        clients = processes.Process(target=watch, args=(address, counts), daemon=True)
        clients.start()
        try:
            settle(lambda: all(count.value for count in counts), "a client got no message")
            samples = list(sort_shift(service, round(3600.0 * hours / PART_S)))
        finally:
            clients.kill()
            clients.join()
        ledger = service.shift.values()
        return samples, [count.value for count in counts], ledger


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.performance.shift", description=__doc__
    )
    parser.add_argument("--hours", type=float, default=8.0)
    wanted = parser.parse_args(arguments)
    begin_s = time.monotonic()
    samples, messages, ledger = condensed(wanted.hours, CellConfig())
    took_s = time.monotonic() - begin_s
    line("shift", f"{wanted.hours:g} h, {samples[-1].done} parts, in {took_s / 60:.1f} min")
    line("  sorted", f"{ledger['counts']}, {ledger['missed']} missed, {ledger['faults']} faults")
    line("  messages to the clients", ", ".join(map(str, messages)))
    if bad := show_growth(samples, LIMITS):
        sys.exit("; ".join(bad))


if __name__ == "__main__":
    main()
