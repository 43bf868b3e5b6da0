"""The control cycle of two servos through our bus, the plain dynamixel_sdk, and rustypot.

A cycle is a sync read of current, velocity and position (126 to 135) and a sync write of the goal
currents. All hosts open the same pseudo-terminal one after the other, round by round; the simulated
servos are a process of their own. They answer at once, so that the host is measured; then paced as
on a line of 1 Mbit/s, where a cycle has 0.78 ms of wire time and a host may sleep; then so while
every core is kept busy by another process; then at once again with lost answers. Time-outs are each
host's own (rustypot's is the caller's: 50 ms, as its examples have it); where one gives up, it is
asked again. A cycle is also asked twice where a busy machine held up the simulated servos.

The aims: at most 1.5 times the p50 of rustypot while it is quiet, a p99 below the plain SDK under
load, and less than one period of the loop for a lost answer.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle

from benchmarks._measure import in_turns, line, quantile, ratio, repeats, same, timed
from benchmarks.performance._servo_clients import (
    Block,
    Client,
    Ours,
    Rusty,
    Sdk,
    Servos,
    servos,
    until_answered,
)
from benchmarks.performance._servo_responder import SERVO_IDS

_LOOP_HZ = 200
_LATE_S = 0.1
_DROP_EVERY = 51
"""About every 50th answer; odd, so that both servos are hit in turn."""
_GOALS = ({1: 100, 2: -100}, {1: -40, 2: 60})


@dataclass(slots=True, kw_only=True)
class Cycles:
    """What one round of cycles took."""

    reads_s: float
    cpu_s: float = 0.0
    good_s: list[float] = field(default_factory=list)
    lost_s: list[float] = field(default_factory=list)


Seen = tuple[int, Block, tuple[int, ...]]
"""Position, status and goal currents that a host has read."""


def one_round(
    make: type[Client], port: str, *, n_cycles: int, n_reads: int, seen: list[Seen]
) -> Cycles:
    """Open the port, do the reads and the cycles, and close the port again."""
    host = make(port)
    try:
        position, _ = until_answered(lambda: host.read(SERVO_IDS[0]))
        reads = timed(
            lambda: [until_answered(lambda: host.read(SERVO_IDS[0])) for _ in range(n_reads)]
        )
        taken = Cycles(reads_s=reads.wall_s)
        goals = cycle(_GOALS)
        cpu_s = time.process_time()
        for _ in range(n_cycles):
            wanted = next(goals)
            start_s = time.perf_counter()
            (block, retries), given_up = until_answered(host.status)
            host.set_goals(wanted)
            wall_s = time.perf_counter() - start_s
            (taken.lost_s if retries or given_up else taken.good_s).append(wall_s)
        taken.cpu_s = (time.process_time() - cpu_s) / n_cycles
        # Where the machine held up an answer for longer than a host waits, let it arrive first: the
        # plain SDK would take it for the answer to its next request.
        time.sleep(_LATE_S)
        reached, _ = until_answered(host.goals)
        same(reached == tuple(wanted.values()), f"{make.__name__} did not set the goals")
        seen.append((position, block, reached))
    finally:
        host.close()
    return taken


@contextmanager
def busy_cores() -> Iterator[int]:
    """Keep as many other processes busy as there are cores; gives their number."""
    number = os.cpu_count() or 1
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield number
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def compare(
    line_of: Servos, hosts: Mapping[str, type[Client]], rounds: int, n_cycles: int, n_reads: int = 0
) -> dict[str, list[Cycles]]:
    """Let the hosts take turns; all must read the same values."""
    seen: dict[str, list[Seen]] = {name: [] for name in hosts}
    taken = in_turns(
        {
            name: partial(
                one_round, make, line_of.port, n_cycles=n_cycles, n_reads=n_reads, seen=seen[name]
            )
            for name, make in hosts.items()
        },
        rounds,
    )
    expected = seen["ServoBus"][0]
    same(
        all(one == expected for every in seen.values() for one in every),
        f"the hosts read different values: {seen}",
    )
    return taken


def good(rounds: list[Cycles]) -> list[float]:
    return [wall_s for one in rounds for wall_s in one.good_s]


def lost(rounds: list[Cycles]) -> list[float]:
    return [wall_s for one in rounds for wall_s in one.lost_s]


def print_cycles(taken: dict[str, list[Cycles]], n_reads: int) -> None:
    for name, rounds in taken.items():
        walls = good(rounds) + lost(rounds)
        reads = ""
        if n_reads:
            each = statistics.median(n_reads / one.reads_s for one in rounds)
            reads = f"{each:6.0f} reads/s, "
        p50, p99 = (1e6 * quantile(walls, share) for share in (0.5, 0.99))
        cpu = 1e6 * statistics.median(one.cpu_s for one in rounds)
        line(
            f"  {name}",
            f"{reads}cycle p50 {p50:.0f} us, p99 {p99:.0f} us, CPU {cpu:.0f} us "
            f"({cpu * _LOOP_HZ * 1e-4:.1f} % of a core at {_LOOP_HZ} Hz)"
            + (f", {len(lost(rounds))} cycles asked twice" if lost(rounds) else ""),
        )
    ours = taken["ServoBus"]
    for name, rounds in taken.items():
        if name != "ServoBus":
            wall = ratio(_medians(ours), _medians(rounds))
            cpu = ratio([one.cpu_s for one in ours], [one.cpu_s for one in rounds])
            line("  ratio", f"ServoBus takes {wall:.2f} x the time, {cpu:.2f} x the CPU of {name}")


def _medians(rounds: list[Cycles]) -> list[float]:
    return [quantile(one.good_s + one.lost_s, 0.5) for one in rounds]


def print_aim(name: str, figure: str, value: float, limit: float) -> None:
    line("  aim", f"{name}: {figure}, {'met' if value < limit else 'MISSED'}")


def print_losses(taken: dict[str, list[Cycles]]) -> None:
    cost_s = {}
    for name, rounds in taken.items():
        hit = lost(rounds)
        same(bool(hit), f"no answer of {name} was lost")
        cost_s[name] = statistics.median(hit) - quantile(good(rounds), 0.5)
        line(
            f"  {name}",
            f"{1e3 * cost_s[name]:.1f} ms more in a cycle that lost an answer "
            f"(worst cycle {1e3 * max(hit):.1f} ms, {len(hit)} such cycles): "
            f"{cost_s[name] * _LOOP_HZ:.1f} periods at {_LOOP_HZ} Hz",
        )
    for name in ("dynamixel_sdk", "rustypot"):
        factor = cost_s[name] / cost_s["ServoBus"]
        line("  ratio", f"a lost answer costs {name} {factor:.1f} times as much as ServoBus")
    periods = cost_s["ServoBus"] * _LOOP_HZ
    print_aim("a lost answer below one period", f"{periods:.2f} periods", periods, 1.0)


def main(effort: float = 1.0) -> None:
    rounds = repeats(7, effort)
    at_once, paced, losing = (repeats(n, effort, least=60) for n in (800, 200, 200))
    n_reads = repeats(500, effort, least=20)
    hosts: dict[str, type[Client]] = {"ServoBus": Ours, "dynamixel_sdk": Sdk, "rustypot": Rusty}
    line("compared", f"two servos, {rounds} rounds in turns, all read and set the same values")
    with servos() as line_of:
        line_of.set(paced=False)
        line(f"answers at once, {rounds} x {at_once} cycles", "")
        quick = compare(line_of, hosts, rounds, at_once, n_reads)
        print_cycles(quick, n_reads)
        slower = ratio(_medians(quick["ServoBus"]), _medians(quick["rustypot"]))
        print_aim("p50 within 1.5 x rustypot's", f"{slower:.2f} x", slower, 1.5)
        line_of.set(paced=True)
        line(f"paced as 1 Mbit/s, {rounds} x {paced} cycles", "")
        print_cycles(compare(line_of, hosts, rounds, paced), 0)
        with busy_cores() as number:
            line(f"paced, {number} processes keep the cores busy", "")
            loaded = compare(line_of, hosts, rounds, paced)
        print_cycles(loaded, 0)
        p99 = {name: quantile(good(taken) + lost(taken), 0.99) for name, taken in loaded.items()}
        share = p99["ServoBus"] / p99["dynamixel_sdk"]
        print_aim("p99 below the plain SDK's under load", f"{share:.2f} x", share, 1.0)
        line_of.set(paced=False, drop_every=_DROP_EVERY)
        line(f"every {_DROP_EVERY}st answer lost, {rounds} x {losing} cycles", "")
        print_losses(compare(line_of, hosts, rounds, losing))


if __name__ == "__main__":
    main()
