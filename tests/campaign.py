"""Random inputs and random commands without end: ``python -m tests.campaign`` (make campaign).

A campaign gives the parsers of `tests.fuzz` bad input and the cell of `tests.faults` random
commands and faults, in pieces: a piece is a number, and each number stands for the same inputs in
every run. Which pieces are done, what became of their inputs and what broke stands in a file, so
that a campaign that was ended goes on where it was. Pieces that broke something are tried again at
each start, until they break nothing any more.
"""

import argparse
import importlib
import json
import logging
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

from tests.faults.state_machine import MACHINES, run_machine
from tests.fuzz.harness import PROPERTIES, Piece

ROOT = Path(__file__).parents[1]
MODULES = (
    "test_servo_bytes",
    "test_can_messages",
    "test_slcan_lines",
    "test_archives",
    "test_recordings",
    "test_texts",
    "test_modbus",
)
"""Modules of `tests.fuzz` with properties."""
MACHINE = "state_machine.all_invariants_hold"
"""Random commands and faults."""
WIRES = {f"state_machine.through_{door}": door for door in MACHINES if door}
"""The same through each door."""
GOAL = 1_000_000
"""Inputs of each parser that guards the grip, and steps of the state machine."""
WIRE_GOAL = 100_000
"""Steps through each door: the cell behind it is that of the state machine."""
FILE_GOAL = 100_000
"""Inputs of each parser of files, which are read before anything moves."""
MACHINE_PIECE = 2000
"""Steps of one piece of the state machine."""
FIRST_MACHINE_SEED = 101
"""Other seeds than those of the tests: other steps."""


@dataclass(slots=True, kw_only=True)
class Progress:
    """What is done of one property."""

    next_piece: int = 0
    """Number of the next piece."""
    inputs: int = 0
    """Inputs, or steps, that were tried."""
    seconds: float = 0.0
    """Time that they took on one processor in s."""
    outcomes: dict[str, int] = field(default_factory=dict)
    """How many ended how."""
    failures: dict[str, list[str]] = field(default_factory=dict)
    """What broke, by the number of its piece."""
    unfinished: list[int] = field(default_factory=list)
    """Pieces before the next one that were still running when the file was written."""

    def add(self, number: int, piece: Piece, seconds: float, *, again: bool) -> None:
        """Take note of a piece; one that is tried again counts no further inputs."""
        self.failures.pop(str(number), None)
        if piece.failures:
            self.failures[str(number)] = list(piece.failures)
        if not again:
            self.inputs += sum(piece.outcomes.values())
            self.seconds += seconds
            self.outcomes = dict(Counter(self.outcomes) + Counter(piece.outcomes))


class Campaign:
    """The properties, how far each is, and the file that this is kept in."""

    def __init__(self, path: Path, goals: Mapping[str, int]) -> None:
        self.path = path
        self.goals = goals
        kept = json.loads(path.read_text("utf-8")) if path.exists() else {}
        self.done = {name: Progress(**values) for name, values in kept.items()}
        for name in goals:
            self.done.setdefault(name, Progress())

    def take(self) -> tuple[str, int] | None:
        """Return the next piece of the property that is least far, None when all are done."""
        for name in self.goals:
            if unfinished := self.done[name].unfinished:
                return name, unfinished.pop()
        shares = {name: self.done[name].inputs / goal for name, goal in self.goals.items()}
        name = min(shares, key=lambda one: (shares[one], self.done[one].next_piece))
        if shares[name] >= 1.0:
            return None
        self.done[name].next_piece += 1
        return name, self.done[name].next_piece - 1

    def broken(self) -> list[tuple[str, int]]:
        """Return the pieces that broke something."""
        return [(name, int(n)) for name in self.goals for n in self.done[name].failures]

    def save(self, running: Sequence[tuple[str, int]] = ()) -> None:
        """Write the file, whole or not at all; pieces that are running are still to be done."""
        kept = {name: asdict(progress) for name, progress in self.done.items()}
        for name, number in running:
            kept[name]["unfinished"].append(number)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        beside = self.path.with_suffix(".new")
        beside.write_text(json.dumps(kept, indent=1), encoding="utf-8")
        beside.replace(self.path)

    def run(self, *, jobs: int, seconds: float) -> None:
        """Try pieces on several processes until all is done or the time is over."""
        end_s = time.monotonic() + seconds
        again = self.broken()
        running: dict[Future[tuple[Piece, float]], tuple[str, int, bool]] = {}
        with ProcessPoolExecutor(
            jobs, mp_context=get_context("spawn"), initializer=_begin_process
        ) as pool:
            while True:
                while len(running) < jobs and time.monotonic() < end_s:
                    repeated = bool(again)
                    taken = again.pop(0) if again else self.take()
                    if taken is None:
                        break
                    running[pool.submit(run_piece, *taken)] = (*taken, repeated)
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    name, number, repeated = running.pop(future)
                    piece, took_s = future.result()
                    self.done[name].add(number, piece, took_s, again=repeated)
                    for text in piece.failures:
                        print(f"{name}, piece {number}: {text}", flush=True)
                self.save([(name, n) for name, n, repeated in running.values() if not repeated])

    def table(self) -> str:
        """Return a line for each property: inputs, goal, what became of them, what is broken."""
        lines = []
        for name, goal in self.goals.items():
            done = self.done[name]
            ended = Counter(done.outcomes).most_common()
            outcomes = "; ".join(f"{outcome} {count:,}" for outcome, count in ended)
            failed = f"; BROKEN in {len(done.failures)} pieces" if done.failures else ""
            lines.append(f"{name}: {done.inputs:,} of {goal:,} ({outcomes}){failed}")
        return "\n".join(lines)

    def complaints(self) -> list[str]:
        """Return what is wrong: what broke, and properties of which nothing is learnt."""
        broken = [
            f"{name}, piece {number}: {text}"
            for name in self.goals
            for number, texts in self.done[name].failures.items()
            for text in texts
        ]
        dull = [
            f"{name}: the same became of all inputs"
            for name in self.goals
            if name not in (MACHINE, *WIRES)
            and self.done[name].inputs
            and len(self.done[name].outcomes) < 2
        ]
        return broken + dull


def load_properties() -> dict[str, int]:
    """Import the properties and return how many inputs each shall meet."""
    for module in MODULES:
        importlib.import_module(f"tests.fuzz.{module}")
    goals = {name: GOAL if one.seeded else FILE_GOAL for name, one in PROPERTIES.items()}
    return {MACHINE: GOAL} | dict.fromkeys(WIRES, WIRE_GOAL) | goals


def run_piece(name: str, number: int) -> tuple[Piece, float]:
    """Try one piece of a property; return what became of it and the time in s."""
    began_s = time.monotonic()
    if name == MACHINE or name in WIRES:
        door = WIRES.get(name, "")
        outcome = run_machine(MACHINE_PIECE, FIRST_MACHINE_SEED + number, door=door)
        failures = [outcome.defect] if outcome.defect else []
        piece = Piece(outcomes={"steps": outcome.steps}, failures=failures)
    else:
        piece = PROPERTIES[name].run(number)
    return piece, time.monotonic() - began_s


def _begin_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the campaign, not its pieces
    logging.disable(logging.CRITICAL)
    load_properties()


def main(arguments: Sequence[str] | None = None) -> None:
    """Go on with the campaign; exits with a message where anything is broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="longest time")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--only", default="", help="properties with this in their name")
    parser.add_argument("--progress", type=Path, default=ROOT / "out" / "campaign.json")
    given = parser.parse_args(arguments)
    goals = {name: goal for name, goal in load_properties().items() if given.only in name}
    if not goals:
        parser.error(f"no property has {given.only!r} in its name")
    campaign = Campaign(given.progress, goals)
    with suppress(KeyboardInterrupt):
        campaign.run(jobs=given.jobs, seconds=given.seconds)
    print(campaign.table())
    print(f"kept in {campaign.path}: the next call goes on from there")
    if complaints := campaign.complaints():
        sys.exit("DEFECT\n" + "\n\n".join(complaints))


if __name__ == "__main__":
    main()
