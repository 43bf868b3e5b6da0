"""Stand-ins for the gripper's tests: a script of exact bytes, and a cell with real dynamics."""

import random
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import REGISTERS
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import XM430_W350, ServoModel
from gripper.force.ramp import ForceRamp
from gripper.gripper import Gripper
from gripper.mechanics.kinematics import Linkage, ParallelLinkage, RackPinion
from gripper.mechanics.transmission import Mechanics
from gripper.settings import HARD_FORCE_CAP_N, GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle
from simulator.clock import VirtualClock
from simulator.servo.gearing import Drive, Friction, data_sheet
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, RackLinkage, ServoMount
from tests.simulator.conftest import ServoBench
from tests.values import measured_drives

STICKING = Drive(
    kt_nm_a=2.8591851666071726,
    back_emf_v_s=2.8591851666071726,
    friction=Friction(
        base_nm=0.219, drive=0.499, load=0.014, load_quadratic_per_nm=0.0056, viscous_nm_s=0.0452
    ),
    inertia_kg_m2=0.02189596382194143,
    winding_ohm=5.217391304347826,
)
"""A gearing that sticks at rest: that of an MX-64 (Rhoban/bam, revision 1b5a1ce, mx64/m6.json) at
low speed, all torques scaled to the graph of an XM430-W350."""
_LAW = STICKING.friction
_RISES_NM_A = (1.0 - _LAW.drive) * STICKING.kt_nm_a
_FALLS_NM_A = (1.0 + _LAW.drive) * STICKING.kt_nm_a
STICKING_DRIVE = DriveCharacteristic(
    coulomb_a=_LAW.base_nm / _RISES_NM_A,
    breakaway_a=_LAW.base_nm / _RISES_NM_A,
    viscous_a_s=_LAW.viscous_nm_s / _RISES_NM_A,
    rising_a_nm=(1.0 + _LAW.load) / _RISES_NM_A,
    falling_a_nm=(1.0 - _LAW.load) / _FALLS_NM_A,
    yielding_share=_RISES_NM_A / _FALLS_NM_A,
    kt_nm_a=XM430_W350.kt_nm_a,
    friction_sd=0.05,
    load_sd=0.04,
)
"""What a measurement of such servos finds."""


@dataclass
class ScriptedStream:
    """Answers exact requests with exact bytes, each piece after a delay; anything else fails."""

    clock: VirtualClock
    script: deque[tuple[bytes, list[tuple[float, bytes]]]] = field(default_factory=deque)
    arriving: list[tuple[float, bytes]] = field(default_factory=list)
    closed: bool = False
    chatter: bytes = b""
    """Bytes that come without an end, one piece each 0.1 ms."""

    def expect(self, request: str, *answers: str | tuple[float, str]) -> "ScriptedStream":
        pieces = [(0.0, a) if isinstance(a, str) else a for a in answers]
        self.script.append((bytes.fromhex(request), [(d, bytes.fromhex(a)) for d, a in pieces]))
        return self

    def write(self, data: bytes, /) -> None:
        assert self.script, f"unexpected request {data.hex()}"
        request, pieces = self.script.popleft()
        assert data.hex() == request.hex()
        self.arriving += [(self.clock.monotonic() + delay_s, piece) for delay_s, piece in pieces]
        self.arriving.sort(key=lambda entry: entry[0])

    def read(self, size: int, timeout_s: float, /) -> bytes:
        if self.chatter:
            self.clock.sleep(1e-4)
            return self.chatter
        deadline_s = self.clock.monotonic() + timeout_s
        if not self.arriving or self.arriving[0][0] > deadline_s:
            self.clock.advance_to(deadline_s)
            return b""
        due_s, piece = self.arriving.pop(0)
        self.clock.advance_to(due_s)
        if len(piece) > size:
            self.arriving.insert(0, (due_s, piece[size:]))
        return piece[:size]

    def drop_input(self) -> None:
        self.arriving = [entry for entry in self.arriving if entry[0] > self.clock.monotonic()]

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def script(clock: VirtualClock) -> Iterator[ScriptedStream]:
    stream = ScriptedStream(clock)
    yield stream
    assert not stream.script, f"{len(stream.script)} requests were never sent"


@pytest.fixture
def bus(script: ScriptedStream, clock: VirtualClock) -> ServoBus:
    return ServoBus(script, baudrate=1_000_000, clock=clock)


@dataclass
class Part:
    """An elastic part between the pads; it floats, so both pads carry the same force."""

    width_m: float
    stiffness_n_m: float
    present: bool

    def press(self, opening_m: float) -> tuple[float, float]:
        """Return the force on each pad in N, and its slope over the way of one finger in N/m."""
        pressed_m = self.width_m - opening_m
        if not self.present or pressed_m <= 0.0:
            return 0.0, 0.0
        return 0.5 * self.stiffness_n_m * pressed_m, 0.5 * self.stiffness_n_m


class SampledForce:
    """A force sensor: 50 Hz, delayed, noisy; ``rate_hz`` makes it send messages, each one scan.

    It reports ``gain`` times the force and ``offset_n`` N.
    """

    def __init__(self, *, noise_n: float, seed: int, rate_hz: float | None) -> None:
        self.noise_n = noise_n
        self.delay_s = 0.03 if rate_hz is None else 0.0015
        self.period_s = 0.02 if rate_hz is None else 1.0 / rate_hz
        # Of slow samples the noise is not known.
        self.known = {"lag_s": 0.0}
        if rate_hz is not None:
            self.known = {"lag_s": 0.0015, "noise_n": 0.7 * noise_n}
        self.dead = False
        self.valid = True
        self.at_least = False
        self.gain, self.offset_n = 1.0, 0.0
        self._random = random.Random(seed)
        self._due_s = 0.0
        self._waiting: deque[tuple[float, ForceSample]] = deque()
        self._latest: ForceSample | None = None
        self._now_s = 0.0

    def measure(self, now_s: float, force_n: tuple[float, float]) -> None:
        self._now_s = now_s
        if now_s >= self._due_s and not self.dead:
            self._due_s += self.period_s
            noisy = tuple(
                max(0.0, self.gain * f + self.offset_n + self._random.gauss(0, self.noise_n))
                for f in force_n
            )
            sample = ForceSample(
                t_s=now_s + self.known["lag_s"],
                force_n=(noisy[0], noisy[1]),
                valid=self.valid,
                at_least=self.at_least,
                **self.known,
            )
            self._waiting.append((now_s + self.delay_s, sample))

    def latest_force(self) -> ForceSample | None:
        while self._waiting and self._waiting[0][0] <= self._now_s:
            self._latest = self._waiting.popleft()[1]
        return self._latest


GENEROUS = {
    "aperture_open_m": 0.03,
    "approach_speed_m_s": 0.02,
    "contact_force_n": 0.5,
    "force_max_n": HARD_FORCE_CAP_N,
    "watchdog_s": 0.2,
}
"""Settings of the test cell: wide open, quick, and with the highest cap of the force."""


class Cell(ServoBench):
    """Simulated servos and fingers, a part and a force sensor under one virtual clock."""

    def __init__(
        self,
        *,
        n_servos: int = 2,
        linkage: str = "parallel",
        model: ServoModel = XM430_W350,
        width_m: float = 0.012,
        stiffness_n_m: float = 20_000.0,
        present: bool = True,
        noise_n: float = 0.2,
        kt_error: float = 0.0,
        friction_error: float = 0.0,
        aperture_m: float = 0.02,
        zero_raw: int = 2048,
        seed: int = 7,
        rate_hz: float | None = None,
        turned: tuple[int, ...] = (),
        drive_sds: tuple[float, float] = (0.1, 0.02),
        zero_off: tuple[int, int] = (0, 0),
        pinion_radius_m: float = 0.012,
        **settings: Any,
    ) -> None:
        """Build the cell; from ``turned`` on, its settings may differ from its mechanics.

        ``width_m`` to ``present`` are those of the `Part`.
        ``drive_sds`` are the uncertainties of friction and torque, as a measurement leaves them.
        ``turned`` are indices of servos, ``zero_off`` is in pulses of opening too wide.
        """
        self.part = Part(width_m, stiffness_n_m, present)
        self.sensor = SampledForce(noise_n=noise_n, seed=seed, rate_hz=rate_hz)
        directions = (1, -1)[:n_servos]
        mounts = [ServoMount(direction=d, zero_raw=zero_raw) for d in directions]
        theirs: Any = ParallelogramLinkage(link_m=0.06)
        self.linkage: Linkage = ParallelLinkage(link_m=0.06, n_servos=n_servos)
        if linkage == "rack":
            theirs = RackLinkage(pinion_radius_m=pinion_radius_m)
            self.linkage = RackPinion(pinion_radius_m=pinion_radius_m, n_servos=n_servos)
        super().__init__(
            range(1, n_servos + 1),
            model=model,
            fingers=lambda motors, _: FingerMechanics(
                motors, mounts, theirs, aperture_m=aperture_m
            ),
        )
        # The friction of the catalogue; that of the data sheet is a loaded one.
        sheet = data_sheet(model)
        for motor in self.motors:
            motor.kt_factor = 1.0 + kt_error
            motor.friction_factor = model.friction_nm / sheet.friction_nm * (1.0 + friction_error)
        self.bus = ServoBus(self.stream, baudrate=1_000_000, clock=self.clock)
        self.settings = GripperSettings(
            servos=tuple(
                ServoSettings(
                    servo_id=i + 1,
                    model=model.name,
                    direction=-d if i in turned else d,
                    zero_raw=zero_raw - d * zero_off[i],
                )
                for i, d in enumerate(directions)
            ),
            **(GENEROUS | settings),
        )
        self.drives = measured_drives(self.settings, *drive_sds)
        self.gripper = self.new_gripper()
        self.force_n = self.peak_n = 0.0
        self.least_n = 1e9
        self.acted_s: list[float] = []

    def new_gripper(self) -> Gripper:
        mechanics = Mechanics(self.settings, self.linkage, self.drives)
        return Gripper(self.bus, mechanics, clock=self.clock, force_sensor=self.sensor)

    def _advance(self, now_s: float) -> None:
        if now_s <= self._last_s:
            return
        force_n, slope_n_m = self.part.press(self.mechanics.aperture_m)
        self.mechanics.step(now_s - self._last_s, (force_n,) * 2, (slope_n_m,) * 2)
        self._last_s = now_s
        self.device.advance_to(now_s)
        self.force_n, _ = self.part.press(self.mechanics.aperture_m)
        self.peak_n = max(self.peak_n, self.force_n)
        self.least_n = min(self.least_n, self.force_n)
        self.sensor.measure(now_s, (self.force_n, self.force_n))

    @property
    def pressed_n(self) -> float:
        """Largest force in N that a finger's current makes beyond friction: against a stop too."""
        return max(
            (abs(motor.current_a) * motor.kt_nm_a - motor.friction_nm()) / 0.06
            for motor in self.motors
        )

    def hold_part(self, ramp: ForceRamp) -> None:
        """Start the gripper and grip the part."""
        self.gripper.start()
        assert self.gripper.grasp(ramp).result is GraspResult.FORCE_REACHED

    def once(
        self, act: Callable[[], object], *, at_n: float = 0.0, in_s: float = 0.0
    ) -> Callable[[Cycle], None]:
        """Return an observer that acts once: at a set-point in N, so long after now in s.

        ``acted_s`` gets the time.
        """
        due_s = self.clock.monotonic() + in_s

        def observe(cycle: Cycle) -> None:
            if not self.acted_s and cycle.setpoint_n >= at_n and cycle.t_s >= due_s:
                self.acted_s.append(self.clock.monotonic())
                act()

        return observe

    @property
    def torques(self) -> list[int]:
        """Torque Enable of each servo."""
        return [self.register(i, "torque_enable") for i in range(len(self.servos))]

    def register(self, index: int, name: str) -> int:
        return self.bus.read(index + 1, REGISTERS[name])


@pytest.fixture
def cell() -> Cell:
    return Cell()


@pytest.fixture
def make_cell() -> Callable[..., Cell]:
    return Cell


@pytest.fixture
def make_started() -> Callable[..., Cell]:
    """Return the maker of cells whose gripper was started."""

    def make(**options: Any) -> Cell:
        cell = Cell(**options)
        cell.gripper.start()
        return cell

    return make


@pytest.fixture
def started(make_started: Callable[..., Cell]) -> Cell:
    return make_started()
