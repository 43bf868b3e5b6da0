"""Random commands and faults: after each step all invariants hold."""

import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from cell.build import Cell, build_cell
from cell.control.controller import CellController
from cell.control.lifecycle import CellLifecycle
from cell.control.plan import GraspStep, Keep, Pose
from cell.simulation import simulation_of
from gripper.dynamixel.control_table import REGISTERS
from gripper.force.loop import Action
from gripper.force.supervision.part_watch import EmptyGrip, PartWatch
from gripper.gripper import Gripper
from gripper.servos.group import Servos
from gripper.values.state import GripperPhase
from pytest_tactile_cell.virtual import VirtualCell
from simulator.errors import SimulatorError
from simulator.faults.injector import check_fault
from simulator.faults.vocabulary import VOCABULARY, FaultEntry, Number
from tests.cell.cells import once
from tests.faults.campaign import PRODUCT_ERRORS, campaign_config
from tests.faults.invariants import (
    FrameWitness,
    InvariantBroken,
    InvariantMonitor,
    Overrun,
    recording_faults,
    spoiling,
)
from tests.fuzz.harness import seed_of_run
from tests.marks import LONG
from tests.values import command_of, raising

pytestmark = pytest.mark.slow

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
    """A cell under random commands and faults; see `Driver`."""

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
            run_state_machine_as_test(seed(1000 * number + part)(CellMachine), settings=chosen)
    except Exception as error:
        error.add_note(f"seed {number}")
        raise
    finally:
        logging.disable(logging.NOTSET)
    return CellMachine.taken


# -- A host program on simulated hardware, driven step by step, with every invariant checked -------


COMMAND_BOUND_S = 40.0
"""Every command has to be over within so many s of simulated time. A finger that a fault opened by
80 degrees closes at 0.06 rad/s, the limit of its impact: that takes 25 s."""
_REMOUNTED = ("servoN.jump", "servoN.horn", "servoN.turned")
"""Faults whose end sends a finger to its goal from elsewhere: the world moves it, not the cell."""
_SUPERVISED = ("IDLE", "HELD", "COMPLETE")
"""States in which a cell reads its servos between commands."""
_UNTRUSTED = frozenset(
    {"object.trapped"} | {f"servoN.{name}" for name in ("jump", "stuck", "turn", "drift", "horn")}
)
"""Faults after which position or force are not known: the torque may go off."""


_SHORT_COMMANDS = {
    "gripper.loop_rate_hz": 100.0,
    "gripper.aperture_open_mm": 12.0,
    "gripper.approach_speed_mm_s": 20.0,
    "gripper.contact_timeout_s": 2.0,
    "sequence.ramp.rate_n_s": 20.0,
    "sequence.ramp.hold_s": 0.05,
    "sequence.max_grasps": 2,
}
"""Config whose commands take little time: coarse pads, a slow loop, short ways."""
_FAST_FINGERS = {
    "gripper.approach_speed_mm_s": 200.0,
    "gripper.force_max_n": 8.0,
    "gripper.linkage.link_mm": 45.0,
    "sequence.force_n": [2.0, 5.0],
}
"""Config that asks for an approach whose impact would be far above its cap of the force."""


class Driver:
    """Hardware that stays, host programs that come and go.

    With ``self_test`` the start proves the servos' bus watchdog; with ``fast`` the config asks for
    faster fingers than its cap of the force allows.
    """

    def __init__(self, *, self_test: bool, fast: bool = False) -> None:
        self._config = campaign_config(
            _SHORT_COMMANDS
            | {"gripper.watchdog_self_test": self_test}
            | (_FAST_FINGERS if fast else {})
        )
        self._folder = Path(tempfile.mkdtemp(prefix="tactile-cell-machine-"))
        self.simulated = simulation_of(self._config)
        self.simulated.place("ball")
        self.monitor = InvariantMonitor(self.simulated, self._config.gripper)
        self.steps = 0
        self.log: list[str] = []
        self._hosts = 0
        self._scanned: set[bytes] = set()
        self._counter = -1
        self._untrusted = self._remounted = False
        self.simulated.clock.on_advance.append(self._watch_scans)
        self.cell = self._new_host()

    @property
    def controller(self) -> CellController:
        return self.cell.controller

    def command(
        self, name: str, call: Callable[[], Any], *, release: bool = False, reboot: bool = False
    ) -> bool:
        """Run a command to its end; return whether it did what it was asked for."""
        asked, done = release or reboot, True
        with self.step(name):
            try:
                with (
                    self.monitor.bounded(COMMAND_BOUND_S),
                    self.monitor.release_asked(motion=release) if asked else nullcontext(),
                ):
                    call()
            except PRODUCT_ERRORS as error:
                done = False
                self.log[-1] += f" -> {type(error).__name__}: {str(error)[:100]}"
            except (InvariantBroken, Overrun) as error:
                self.monitor.broken.append(str(error))
            except Exception as error:
                self.monitor.broken.append(f"{name} ended with {type(error).__name__}: {error}")
        return done

    def do(self, name: str) -> bool:
        """Run a command without arguments; `release_held` lets go of what an earlier host left."""
        command = command_of(self.controller, name)
        return self.command(name, command, release=name.startswith("release"))

    def grasp(self, x_mm: float, force_n: float, turn_rad: float) -> bool:
        step = GraspStep(pose=Pose(x_m=1e-3 * x_mm, rotation_rad=turn_rad), force_n=force_n)
        return self.command(
            f"grasp x={x_mm} mm, {force_n} N, {turn_rad} rad", lambda: self.controller.grasp(step)
        )

    def grip(self, force_n: float) -> bool:
        return self.command(f"grip {force_n} N", lambda: self.controller.grip(force_n, Pose()))

    def identify(self, force_n: float, keep: Keep = Keep.NEVER) -> bool:
        step = GraspStep(pose=Pose(), force_n=force_n)
        witness = FrameWitness(
            lambda: self._scanned,
            lambda: spoiling(self.simulated.injector.faults, self.simulated.clock.monotonic()),
        )
        return self.command(
            f"identify {force_n} N, keep {keep}",
            lambda: self.controller.identify(witness, [step], early=True, keep=keep),
        )

    def cancel_soon(self, after_s: float) -> None:
        """Let another thread ask for a stop in so many s."""
        with self.step(f"cancel in {after_s} s"):
            once(self.simulated.clock, lambda: True, self.controller.life.cancel, after_s)

    def carry(self, force_n: float, text: str, seconds: float) -> None:
        """Grip, bring a fault about while the part is carried, and look at it."""
        if self.grip(force_n):
            self.inject(text)
            self.wait(seconds)
            self.do("verify")

    def clear(self, reboot: bool) -> bool:
        """Acknowledge the fault. A servo that is rebooted lets go: it was asked for."""
        name = f"clear reboot={reboot}"
        return self.command(name, lambda: self.controller.life.clear(reboot=reboot), reboot=reboot)

    def wait(self, seconds: float) -> None:
        cell = VirtualCell(config=self._config, cell=self.cell, simulated=self.simulated)
        self.command(f"wait {seconds} s", lambda: cell.idle(seconds))

    def restart(self) -> None:
        with self.step("restart the host"):
            self._finish_host()
            self.cell = self._new_host()

    def kill(self, dead_s: float) -> None:
        """Kill the host program; after a time another one comes."""
        with self.step(f"kill the host for {dead_s} s"):
            recording = self.cell.recording_path
            if recording is not None:
                copy = self._folder / "killed.mcap"
                shutil.copyfile(recording, copy)
                self.monitor.broken += recording_faults(copy, whole=False)
            self.monitor.attach(None)
            for open_anew in (self.simulated.open_servo_port, self.simulated.open_can_bus):
                with suppress(SimulatorError):  # an adapter that is out is so for both hosts
                    open_anew()  # what the old one has fails from now on
            self.cell.close()
            self.simulated.clock.sleep(dead_s)
            self.cell = self._new_host()

    def _new_host(self) -> Cell:
        self._hosts += 1
        folder = self._folder / f"host{self._hosts}"
        folder.mkdir()
        cell = build_cell(self._config, folder=folder, simulated=self.simulated)
        self.monitor.attach(cell)
        cell.controller.moves.present("ball")
        return cell

    def _finish_host(self) -> None:
        recording = self.cell.recording_path
        try:
            self.cell.close()
        except Exception as error:
            self.monitor.broken.append(f"close() raised {type(error).__name__}: {error}")
        self.monitor.attach(None)
        if recording is not None:
            self.monitor.broken += recording_faults(recording, whole=True)
            shutil.rmtree(recording.parent)

    def inject(self, text: str) -> None:
        """Inject a fault; one that is refused changes nothing."""
        with self.step(f"inject {text}", refusal=SimulatorError):
            name = self.simulated.inject(text).entry.name
            self._untrusted = self._untrusted or name in _UNTRUSTED
            self._remounted = self._remounted or name in _REMOUNTED
            if name in _REMOUNTED and self.controller.life.state.value not in _SUPERVISED:
                # Nothing reads the servos, and a servo under torque closes by its own control.
                self.monitor.pushed()

    def heal(self) -> None:
        """End all faults, and plug everything in."""
        with self.step("heal"):
            if self._remounted:
                self.monitor.pushed()
            self._remounted = False
            self.simulated.injector.clear_all()

    def place(self, label: str) -> None:
        """Bring another object, where the fingers let it."""
        with self.step(f"place {label}", refusal=SimulatorError):
            self.simulated.place(label)
            self.controller.moves.present(label)

    def recover(self) -> None:
        """Do what a person does after a fault, until the cell is started again."""
        self.heal()
        if self.controller.life.fault is not None:
            self.clear(reboot=True)
        self.wait(0.5)
        for states, name in (
            ({"RESETTING"}, "release_held"),
            ({"RESETTING"}, "reset"),
            ({"COMPLETE", "HELD", "IDLE"}, "release"),
        ):
            if self.controller.life.state.value in states:
                self.do(name)
        if self.simulated.devices.world.placed is None:
            self.place("ball")
        self._untrusted = False
        if self.controller.life.state.value == "STOPPED":
            self.do("start")

    def make_ready(self, how: str) -> None:
        """Do what may be needed before a grasp: nothing, a start, or all that a person does."""
        if self.controller.life.state.value != "IDLE" and how:
            self.do("start") if how == "start" else self.recover()

    def close(self) -> None:
        self.monitor.close()
        self._finish_host()
        self.simulated.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self.check()

    def check(self) -> None:
        """Raise InvariantBroken with all steps so far, if anything was broken."""
        if self.monitor.broken:
            steps = "\n  ".join(self.log)
            raise InvariantBroken(f"{'; '.join(self.monitor.broken[:3])}\nafter\n  {steps}")

    @contextmanager
    def step(self, name: str, refusal: type[Exception] | tuple[()] = ()) -> Iterator[None]:
        """Write a step down, and that it was refused; at its end nothing may be broken."""
        now_s = self.simulated.clock.monotonic()
        self.log.append(f"{now_s:8.3f} s {self.controller.life.state.value:<10} {name}")
        self.steps += 1
        try:
            yield
        except refusal as error:
            self.log[-1] += f" -> {error}"
        self.monitor.limp_allowed = self._untrusted
        self.check()

    def _watch_scans(self, _now_s: float) -> None:
        scanner = self.simulated.unit.scanner
        if scanner.counter != self._counter:
            self._counter = scanner.counter
            if scanner.counts is not None:
                self._scanned.add(scanner.format.samples(scanner.counts))


# -- Whatever is asked and whatever fails, all invariants hold -------------------------------------


WALKS = [(seed, 50) for seed in (1, 2, 3, 4)]
"""Seed and steps of the walks of each change."""
CAN_OFF = "can.off@contact+100ms"
LONG_WALKS = [LONG(seed, STEPS) for seed in range(1, PIECES + 1)]


@pytest.mark.no_cover  # to count lines takes as long again as to run them
@pytest.mark.parametrize(("seed", "steps"), [*WALKS, *LONG_WALKS])
def test_whatever_is_asked_and_whatever_fails_all_invariants_hold(seed: int, steps: int) -> None:
    assert run_machine(steps, seed_of_run(seed)) >= steps


@given(fault_texts())
@settings(max_examples=200)
def test_the_machine_draws_faults_that_there_are(text: str) -> None:
    check_fault(text)


# What the machine is for: each of these defects, put in on purpose, is found.


def drive(*, fault: str = CAN_OFF) -> None:
    """Fail in a grasp, clear it, and go on."""
    with closing(Driver(self_test=False)) as cell:
        cell.do("start")
        cell.inject(fault)
        cell.grasp(0.0, 3.0, 0.0)
        cell.wait(0.1)
        cell.recover()
        cell.identify(3.0)


LIMP = "torque of servo 1 off with a part in the grip"
TORQUE = "torque of servo . on while CLEARING, without a reset"
PUSH = r"goal currents from .* to \[200, .* while ABORTED"


@pytest.mark.parametrize(
    ("owner", "method", "written", "fault", "complaint"),
    [
        (Gripper, "keep_grip", ("torque_enable", 0), CAN_OFF, LIMP),
        (Gripper, "clear_fault", ("torque_enable", 1), "servo1.overload@contact+50ms", TORQUE),
        (CellLifecycle, "tick", ("goal_current", 200), CAN_OFF, PUSH),
    ],
)
def test_a_grip_that_a_fault_opens_and_torque_that_comes_by_itself_are_found(
    monkeypatch, *, owner: type, method: str, written: tuple[str, int], fault: str, complaint: str
) -> None:
    """The method writes to the servos after its work."""
    register, value = written
    plain = getattr(owner, method)

    def spoilt(it: Any, **options: Any) -> None:
        plain(it, **options)
        if isinstance(it, Gripper) or it.fault is not None:
            gripper = it if isinstance(it, Gripper) else it.hand.gripper
            for servo in gripper.settings.servos:
                gripper.bus.write(servo.servo_id, REGISTERS[register], value)

    monkeypatch.setattr(owner, method, spoilt)
    with pytest.raises(InvariantBroken, match=complaint):
        drive(fault=fault)


def test_a_part_that_the_cell_lets_go_by_itself_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    fault = "unit.force_gain=0@contact+80ms"
    drive(fault=fault)
    monkeypatch.setattr(PartWatch, "_confirmed", lambda *_: True)
    monkeypatch.setattr(EmptyGrip, "step", lambda *_: Action(done=True))
    with pytest.raises(InvariantBroken, match=r"open by themselves on a part .* [123]\.\d"):
        drive(fault=fault)


def test_fingers_that_a_cancel_does_not_stop_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def letting_go() -> None:
        def fast() -> bool:
            wide = cell.simulated.devices.mechanics.aperture_m > 0.008
            return cell.controller.hand.phase is GripperPhase.RELEASING and wide

        with closing(Driver(self_test=False)) as cell:
            cell.do("start")
            once(cell.simulated.clock, fast, cell.controller.life.cancel)
            cell.grasp(0.0, 3.0, 0.0)
            cell.wait(0.2)

    letting_go()
    monkeypatch.setattr(Servos, "stop_motion", lambda _servos: [])
    with pytest.raises(InvariantBroken, match=r"the fingers went on from .* after their stop"):
        letting_go()


@pytest.fixture
def cell() -> Iterator[Driver]:
    """A driver that was started; what it has found broken counts no more at its end."""
    made = Driver(self_test=False)
    made.do("start")
    yield made
    made.monitor.broken.clear()
    made.close()


def test_a_label_from_spoiled_taxels_is_found(cell, monkeypatch) -> None:
    monkeypatch.setattr(f"{__name__}.spoiling", lambda _faults, _now_s: ["taxels.off=0.9"])
    with pytest.raises(InvariantBroken, match=r"a label in spite of taxels.off=0.9"):
        cell.identify(3.0)


def test_a_force_above_the_cap_is_found(cell: Driver) -> None:
    cell.grasp(0.0, 3.0, 0.0)
    cell.monitor._force_max_n = 2.0
    with pytest.raises(InvariantBroken, match="the cap is 2 N"):
        cell.grasp(0.0, 3.0, 0.0)


def test_frames_that_nobody_scanned_are_found(cell: Driver) -> None:
    cell._watch_scans = lambda _now_s: None  # type: ignore[method-assign]
    cell._scanned.clear()
    cell.simulated.clock.on_advance.pop()
    with pytest.raises(InvariantBroken, match="never scanned"):
        cell.identify(3.0)


def test_an_error_without_a_type_and_a_command_without_an_end_are_found(cell, monkeypatch) -> None:
    monkeypatch.setattr(f"{__name__}.COMMAND_BOUND_S", 1.0)

    def hang() -> None:
        while True:
            cell.simulated.clock.sleep(0.1)

    fail = raising(KeyError("nobody expects it"))
    for call, complaint in ((fail, "ended with KeyError"), (hang, "did not end within its time")):
        with pytest.raises(InvariantBroken, match=complaint):
            cell.command("x", call)
