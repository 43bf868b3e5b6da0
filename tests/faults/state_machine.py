"""Random commands and random faults for a cell, and what must hold after each step."""

import logging
from typing import Any

from hypothesis import HealthCheck, Phase, seed, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from cell.control.plan import Keep
from simulator.faults.entry import FaultEntry, Number
from simulator.faults.vocabulary import VOCABULARY
from tests.faults.driver import Driver

PIECES = 10
"""Pieces that the tests run, each from a seed of its own."""
STEPS = 300
"""Steps of one of them."""
ROUNDS = 50
"""Rules that are drawn for one cell before a new one takes its place."""
_STEPS_OF_ROUNDS = 75
"""About so many steps are driven by them: a grasp with a fault is two, a recovery seven."""

# Faults: every name of the vocabulary, any value, any moment

_GENTLE = {
    "can.flood": (10.0, 2000.0),
    "can.delayed": (0.001, 0.5),
    "can.lose_next": (1, 30),
    "servos.lose_next": (1, 2),
    "unit.forces_late": (0.002, 0.1),
    "unit.forces_each": (1, 30),
    "unit.force_gain": (-1.5, 3.0),
    "unit.force_offset": (-6.0, 6.0),
    "unit.centre_shift": (-3.0, 3.0),
    "object.slips": (5.0, 200.0),
    "servoN.supply": (5.0, 16.0),
    "servoN.jump": (-0.5, 0.5),
    "servoN.turn": (-2, 2),
    "servoN.drift": (-0.5, 0.5),
    "taxels.offset": (-60.0, 60.0),
    "taxels.gain": (0.0, 3.0),
    "taxels.force_gain": (0.0, 3.0),
    "taxels.saturated": (0.0, 1.0),
}
"""Where most of a fault's range is of no interest, the part that is drawn from."""
_SETTINGS = (
    "servoN.wrong=operating_mode:1",
    "servoN.wrong=current_limit:100",
    "servoN.wrong=temperature_limit:40",
    "servoN.wrong=shutdown:0",
    "servoN.wrong=return_delay_time:250",
    "servoN.wrong=baud_rate:1",
    "unit.wrong=serial:99",
    "unit.wrong=product:7",
    "unit.wrong=taxels:400",
    "taxels.stuck_at=7:0",
    "taxels.stuck_at=3:200",
)


def _values(entry: FaultEntry) -> st.SearchStrategy[str]:
    if entry.value is None:
        return st.just(entry.name)
    if not isinstance(entry.value, Number):
        return st.sampled_from([text for text in _SETTINGS if text.startswith(entry.name)])
    low, high = _GENTLE.get(entry.name, (entry.value.low, entry.value.high))
    if entry.value.whole:
        number = st.integers(int(low), int(high)).map(str)
    else:
        number = st.floats(low, high).map(lambda value: f"{value:.4g}")
    return st.one_of(st.just(entry.name), number.map(lambda value: f"{entry.name}={value}"))


def _windows(entry: FaultEntry) -> st.SearchStrategy[str]:
    at = st.one_of(
        st.just(""),
        st.integers(0, 900).map(lambda ms: f"@{ms}ms"),
        st.integers(0, 300).map(lambda ms: f"@contact+{ms}ms"),
        st.just("@moving"),
    )
    if entry.moment:
        return at
    timed = st.tuples(st.integers(0, 900), st.integers(10, 600)).map(
        lambda pair: f"@{pair[0]}ms..{sum(pair)}ms"
    )
    return st.one_of(at, timed)


def fault_texts() -> st.SearchStrategy[str]:
    """Return texts of every fault of the vocabulary, at random moments."""

    def of(entry: FaultEntry) -> st.SearchStrategy[str]:
        text = st.tuples(_values(entry), _windows(entry)).map("".join)
        if not entry.name.startswith("servoN"):
            return text
        number = st.sampled_from(("servo1", "servo2"))
        return st.tuples(number, text).map(lambda pair: pair[1].replace("servoN", pair[0]))

    # The machine's cell has no axes or boards, and nobody mounts a finger the other way round while
    # it runs.
    names = sorted(
        name
        for name in VOCABULARY
        if not name.startswith(("axisN", "board")) and name != "servoN.turned"
    )
    return st.sampled_from(names).flatmap(lambda name: of(VOCABULARY[name]))


_FAULTS = fault_texts()
_FORCE = st.sampled_from((0.7, 1.0, 3.0, 3.0, 5.0, 8.0, 14.2, 14.9, 40.0))
_TURN_RAD = st.sampled_from((0.0, 0.7, 1.57))
_READY = st.sampled_from(("", "start", "recover", "recover "))
_WAIT_S = st.sampled_from((0.005, 0.02, 0.1, 0.4))
_X_MM = st.sampled_from((0.0, 1.0, -2.0, 4.0, 40.0))
_JOBS = st.one_of(
    st.tuples(st.just("grasp"), _X_MM, _FORCE, _TURN_RAD),
    st.tuples(st.just("identify"), _FORCE, st.sampled_from(Keep)),
    st.tuples(st.just("grip"), _FORCE),
    st.tuples(st.just("carry"), _FORCE, _FAULTS, _WAIT_S),
)
"""Methods of `Driver` that move the fingers, with their arguments."""
_PLAIN = ("start", "verify", "cancel", "release", "release_held", "reset", "shutdown")
_OTHERS = st.one_of(
    st.tuples(st.just("do"), st.sampled_from(_PLAIN)),
    st.tuples(st.just("clear"), st.booleans()),
    st.tuples(st.just("wait"), _WAIT_S),
    st.tuples(st.just("kill"), st.sampled_from((0.0, 0.05, 0.3))),
    st.tuples(st.just("inject"), _FAULTS),
    st.tuples(st.just("place"), st.sampled_from(("ball", "box"))),
    st.tuples(st.sampled_from(("restart", "heal", "recover"))),
)
"""Its other methods."""


class CellMachine(RuleBasedStateMachine):
    """A cell under random commands and faults; see `tests.faults.driver`."""

    taken = 0

    @initialize(self_test=st.booleans(), fast=st.booleans(), started=st.booleans())
    def begin(self, self_test: bool, fast: bool, started: bool) -> None:
        self.driver = Driver(self_test=self_test, fast=fast)
        if started:
            self.driver.do("start")

    @rule(
        ready=_READY,
        faults=st.lists(_FAULTS, max_size=2),
        cancel_s=st.none() | st.floats(0.0, 0.9),
        job=_JOBS,
    )
    def job(self, ready: str, faults: list[str], cancel_s: float | None, job: Any) -> None:
        """Run a job, with faults, or with a stop that another thread asks for."""
        self.driver.make_ready(ready)
        for text in faults:
            self.driver.inject(text)
        if cancel_s is not None:
            self.driver.cancel_soon(cancel_s)
        self._do(job)

    @rule(commands=st.lists(_OTHERS, min_size=1, max_size=4))
    def others(self, commands: list[Any]) -> None:
        for command in commands:
            self._do(command)

    def _do(self, command: Any) -> None:
        name, *arguments = command
        getattr(self.driver, name)(*arguments)

    def teardown(self) -> None:
        if hasattr(self, "driver"):
            CellMachine.taken += self.driver.steps
            self.driver.close()


def run_machine(steps: int, number: int) -> int:
    """Run at least so many steps, from a seed, which an error names; return how many they were."""
    logging.disable(logging.CRITICAL)
    CellMachine.taken = part = 0
    try:
        while CellMachine.taken < steps:
            part += 1
            chosen = settings(
                max_examples=max(1, (steps - CellMachine.taken) // _STEPS_OF_ROUNDS),
                stateful_step_count=ROUNDS,
                deadline=None,
                database=None,
                phases=(Phase.generate,),
                print_blob=False,
                suppress_health_check=list(HealthCheck),
            )
            seeded = seed(1000 * number + part)(CellMachine)
            run_state_machine_as_test(seeded, settings=chosen)
    except Exception as error:
        error.add_note(f"seed {number}")
        raise
    finally:
        logging.disable(logging.NOTSET)
    return CellMachine.taken
