"""The sensor: tare, forces under noise, filters, quality, frozen and broken taxels."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from tactile.errors import CalibrationError, FrameTimeout, TareRefused, ZeroDrifted
from tactile.layout import TaxelLayout, paper_layout, pinch_layout
from tactile.sensor.calibration import FoamCalibration, TableCalibration
from tactile.sensor.filters import ActiveTaxels, Neighbourhood, fill_bad
from tactile.sensor.sensor import SensorStatistics, TactileSensor, TaxelForces
from tactile.sensor.settings import SensorSettings
from tactile.sensor.tare import assess_health, compute_tare
from tactile.source import (
    Arrivals,
    ForceMessage,
    FrameStatistics,
    PadZero,
    ScanStatus,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)
from tests.marks import LONG
from tests.tactile.conftest import counts_of

LAYOUT = paper_layout()
CALIBRATION = FoamCalibration(255)
IDENTITY = SourceIdentity(serial=4)

# Share of the force on each taxel of five, by row and column from the middle.
FOOTPRINTS = {
    "plus": {(0, 0): 0.4, (1, 0): 0.15, (-1, 0): 0.15, (0, 1): 0.15, (0, -1): 0.15},
    "flat": {(0, 0): 0.2, (1, 0): 0.2, (-1, 0): 0.2, (0, 1): 0.2, (0, -1): 0.2},
    "line": {(-2, 0): 0.1, (-1, 0): 0.25, (0, 0): 0.3, (1, 0): 0.25, (2, 0): 0.1},
    "blob": {(0, 0): 0.3, (0, 1): 0.2, (1, 0): 0.2, (1, 1): 0.2, (2, 0): 0.1},
}


class Frames:
    """A frame source without a bus: a frame every 20 ms, and the clock that goes with it."""

    identity = IDENTITY
    statistics = SourceStatistics(frames=FrameStatistics())

    def __init__(self, layout: TaxelLayout = LAYOUT, seed: int = 1) -> None:
        self.layout = layout
        self.now_s = 0.0
        self.next_s = 0.02
        self.rng = np.random.default_rng(seed)
        self.base = np.zeros(layout.n_taxels)
        self.noise = True
        self.status = 0
        self.counter = 0
        self.running = True
        self.stuck: dict[int, int] = {}
        self.alter: Callable[[np.ndarray], None] = lambda counts: None
        self.closed = False

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        self.now_s += seconds

    def start(self) -> SourceIdentity:
        return self.identity

    def stop(self) -> None:
        self.closed = True

    def set_zero(self, zero: PadZero) -> None:
        raise AssertionError("it sends no force messages")

    def poll(self) -> Arrivals:
        frames = []
        while self.running and self.now_s >= self.next_s:
            counts = self.base.copy()
            if self.noise:
                counts += np.clip(np.abs(self.rng.normal(0, 10, len(counts))), 1, 20)
            counts = np.clip(np.rint(counts), 0, self.layout.adc_max).astype(np.uint16)
            counts[list(self.stuck)] = list(self.stuck.values())
            self.alter(counts)
            t_s, counter, status = self.next_s, self.counter, self.status
            frames.append(TactileFrame(t_s=t_s, counter=counter, status=status, counts=counts))
            self.counter += 1
            self.next_s += 0.02
        return Arrivals(tuple(frames), self.new_forces())

    def new_forces(self) -> tuple[ForceMessage, ...]:
        return ()

    def press(self, force_n: float, shape: str = "plus", finger: int = 0) -> None:
        forces = np.zeros(len(self.base))
        start = LAYOUT.taxels_of(LAYOUT.gripping_pads[finger]).start
        for (row, column), share in FOOTPRINTS[shape].items():
            forces[start + (8 + row) * 4 + 1 + column] = force_n * share
        self.base = counts_of(CALIBRATION, forces)


def make(
    settings: SensorSettings | None = None, seed: int = 1, *, noise: bool = True
) -> tuple[TactileSensor, Frames]:
    frames = Frames(seed=seed)
    frames.noise = noise
    sensor = TactileSensor(frames, CALIBRATION, clock=frames, settings=settings)
    sensor.start()
    return sensor, frames


def tared(seed: int) -> tuple[TactileSensor, Frames]:
    sensor, frames = make(seed=seed)
    sensor.tare()
    return sensor, frames


def noiseless() -> tuple[TactileSensor, Frames]:
    sensor, frames = make(noise=False)
    sensor.tare(10)
    return sensor, frames


@pytest.fixture
def frames() -> Frames:
    return Frames()


@pytest.fixture
def sensor(frames: Frames) -> TactileSensor:
    """A sensor that has taken its zero."""
    made = TactileSensor(frames, CALIBRATION, clock=frames)
    made.start()
    made.tare()
    return made


def readings(sensor: TactileSensor, frames: Frames, n: int) -> list:
    result = []
    while len(result) < n:
        frames.sleep(0.005)
        result += sensor.poll()
    return result[:n]


# --- force ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["plus", "blob", LONG("flat"), LONG("line")])
def test_force_of_a_five_taxel_footprint_under_the_papers_noise(shape) -> None:
    """Bias below 3 % and 1.5 hundredths of a newton more for the zero, spread below 0.2 N."""
    for force_n in (2.0, 4.0, 8.0):
        means, spreads = [], []
        for seed in range(4):
            sensor, frames = tared(seed=seed)
            frames.press(force_n, shape)
            forces = [r.finger_force_n[0] for r in readings(sensor, frames, 83)[3:]]
            means.append(np.mean(forces))
            spreads.append(np.std(forces))
        assert abs(np.mean(means) - force_n) < 0.03 * force_n
        assert np.sqrt(np.mean(np.square(spreads))) < 0.2
        assert np.max(np.abs(np.array(means) - force_n)) < 0.03 * force_n + 0.08


def test_untouched_pads_give_exactly_no_force(sensor, frames) -> None:
    idle = readings(sensor, frames, 500)
    assert len([r for r in idle if r.finger_force_n != (0.0, 0.0)]) <= 2
    assert all(r.ok for r in idle[2:])
    assert not idle[2].active.any()


def test_fingers_and_pads_are_kept_apart(sensor, frames) -> None:
    frames.press(3.0, finger=1)
    reading = readings(sensor, frames, 5)[-1]
    assert reading.finger_force_n[0] == 0.0
    assert reading.finger_force_n[1] == pytest.approx(3.0, abs=0.5)
    assert reading.force_n.sum() == pytest.approx(reading.finger_force_n[1])
    assert set(LAYOUT.taxel_pad[reading.active]) == {5}
    with pytest.raises(ValueError, match="read-only"):
        reading.force_n[0] = 1.0


# --- quality -------------------------------------------------------------------------------------


def test_readings_before_the_tare_are_not_ok() -> None:
    sensor, frames = make()
    first = readings(sensor, frames, 1)[0]
    assert (first.ok, first.reason) == (False, "not tared since the start")
    assert first.finger_force_n == (0.0, 0.0)
    sensor.tare()
    after = readings(sensor, frames, 4)
    assert [r.ok for r in after] == [False, False, True, True]
    assert "too few frames" in after[0].reason


def test_a_gap_starts_the_mean_anew(sensor, frames) -> None:
    frames.press(4.0)
    readings(sensor, frames, 5)
    frames.next_s += 0.2
    after = readings(sensor, frames, 4)
    assert [r.ok for r in after] == [False, False, True, True]
    assert after[0].finger_force_n[0] == pytest.approx(4.0, abs=0.8)


def test_a_converter_fault_is_an_objection(sensor, frames) -> None:
    frames.status = ScanStatus.CONVERTER_FAULT
    assert "self-test" in readings(sensor, frames, 4)[-1].reason


def test_a_taxel_that_gets_stuck_is_filled_from_its_neighbours(sensor, frames) -> None:
    frames.stuck = {40: 180}
    assert readings(sensor, frames, 10)[-1].finger_force_n[0] > 1.0
    after = readings(sensor, frames, 40)[-1]
    assert after.finger_force_n[0] == 0.0
    assert after.ok


def test_frozen_samples_are_a_fault_that_latches(sensor, frames) -> None:
    readings(sensor, frames, 5)
    frames.stuck = dict(enumerate(readings(sensor, frames, 1)[0].frame.counts.tolist()))
    start_s = frames.now_s
    with pytest.raises(FrameTimeout, match=r"identical for 0\.08"):
        readings(sensor, frames, 20)
    assert frames.now_s - start_s <= 0.1
    frames.stuck = {}
    with pytest.raises(FrameTimeout, match="identical"):
        sensor.poll()
    sensor.start()
    assert readings(sensor, frames, 1)


def test_without_noise_the_width_counts_only_while_something_is_touched() -> None:
    sensor, frames = noiseless()
    sensor.aim(0.0, 0.018)
    readings(sensor, frames, 10)
    sensor.aim(0.0, 0.010)
    assert readings(sensor, frames, 20)[-1].ok
    frames.press(2.0)
    readings(sensor, frames, 10)
    sensor.aim(0.0, 0.0094)
    with pytest.raises(FrameTimeout, match=r"the width by 0\.6 mm"):
        readings(sensor, frames, 2)


def test_without_noise_the_first_force_that_is_wanted_is_no_change() -> None:
    sensor, frames = noiseless()
    sensor.aim(0.0, 0.010)
    frames.press(3.0)
    readings(sensor, frames, 10)
    sensor.aim(3.4, 0.010)
    assert readings(sensor, frames, 20)[-1].ok
    sensor.aim(4.5, 0.010)
    with pytest.raises(FrameTimeout, match=r"the force changed by 1\.1 N"):
        readings(sensor, frames, 2)


@pytest.mark.parametrize(("stuck", "pressed"), [(255, 24), (255, 41), (0, 33)])
def test_a_taxel_that_jumps_beside_calm_neighbours_is_masked_at_once(
    sensor, frames, stuck, pressed
) -> None:
    frames.press(3.0)
    before = readings(sensor, frames, 5)[-1]
    frames.stuck = {pressed: stuck}
    after = readings(sensor, frames, 5)
    assert all(r.ok for r in after)
    assert [np.flatnonzero(r.bad).tolist() for r in after] == [[pressed]] * 5
    lost_n = 1.2 if pressed == 33 else 0.5  # 33 is the middle: its neighbours know half of it
    assert after[-1].finger_force_n[0] == pytest.approx(before.finger_force_n[0], abs=lost_n)


def test_a_hard_touch_is_no_broken_taxel(sensor, frames) -> None:
    forces = np.zeros(408)
    forces[33], forces[[29, 32, 34, 37]] = 20.0, 1.0
    frames.base = counts_of(CALIBRATION, forces)
    reading = readings(sensor, frames, 4)[-1]
    assert not reading.bad.any()
    assert reading.reason == "1 taxels of finger 0 saturated: press with less force"


def test_more_broken_taxels_than_allowed_make_the_force_invalid(sensor, frames) -> None:
    frames.stuck = dict.fromkeys((0, 12, 27, 61), 255)
    reading = readings(sensor, frames, 4)[-1]
    assert (reading.ok, reading.reason) == (False, "4 taxels of finger 0 bad")
    assert sensor.statistics == SensorStatistics(bad_taxels=4, void_frames=2)


def test_a_pad_that_rests_high_and_reads_0_does_not_measure() -> None:
    sensor, frames = make(SensorSettings(rest_share=0.75))
    frames.base[:] = 90.0
    sensor.tare()
    frames.stuck = dict.fromkeys(range(64), 0)
    assert readings(sensor, frames, 4)[-1].reason == "64 taxels of finger 0 bad"


def test_a_saturated_pad_beside_the_grip_is_noted_only(sensor, frames) -> None:
    frames.base[LAYOUT.taxels_of(1)] = 255.0
    reading = readings(sensor, frames, 5)[-1]
    assert reading.ok
    assert reading.saturated[LAYOUT.taxels_of(1)].all()
    assert (sensor.statistics.saturated_frames, sensor.statistics.void_frames) == (5, 0)
    sensor.check_zero()


def test_pads_beside_the_grip_that_drift_make_the_force_invalid(sensor, frames) -> None:
    frames.base[:] = 8.0
    reading = readings(sensor, frames, 5)[-1]
    assert not reading.ok
    assert "the zero of the pads beside the grip has drifted by +7." in reading.reason


def test_one_bad_taxel_of_a_small_pad_is_no_reason_to_refuse_a_zero() -> None:
    sensor, frames = make()
    frames.stuck = {LAYOUT.taxels_of(4).start: 0}
    assert sensor.tare().health.kinds["dead"].sum() == 1
    sensor, frames = make(SensorSettings(bad_share=0.0))
    frames.stuck = {LAYOUT.taxels_of(4).start: 0}
    with pytest.raises(TareRefused, match=r"8% of the taxels of pad finger0\.tip"):
        sensor.tare()


# --- drift ---------------------------------------------------------------------------------------


def test_the_zero_of_open_pads_is_checked_pad_by_pad(sensor, frames) -> None:
    sensor.check_zero()
    readings(sensor, frames, 5)
    frames.press(6.0)
    readings(sensor, frames, 5)
    sensor.check_zero()
    frames.base[:] = 0.0
    frames.base[LAYOUT.taxels_of(5)] = 5.0
    readings(sensor, frames, 5)
    with pytest.raises(ZeroDrifted, match=r"finger1\.inner has drifted by \+"):
        sensor.check_zero()


def test_noise_alone_is_no_drift() -> None:
    sensor, frames = tared(seed=3)
    for _ in range(200):
        assert readings(sensor, frames, 1)
        sensor.check_zero()


def test_without_pads_beside_the_grip_only_open_pads_are_judged() -> None:
    frames = Frames(pinch_layout())
    sensor = TactileSensor(frames, TableCalibration((1000.0,), (1.0,), 4095), clock=frames)
    sensor.start()
    sensor.tare(20)
    frames.base[:] = 50.0
    assert readings(sensor, frames, 5)[-1].ok
    with pytest.raises(ZeroDrifted, match=r"\+50"):
        sensor.check_zero()


# --- life cycle ----------------------------------------------------------------------------------


def test_read_waits_for_a_new_frame_and_latest_keeps_it(sensor, frames) -> None:
    assert sensor.latest is None
    before_s, reading = frames.now_s, sensor.read(0.5)
    assert reading.t_s >= before_s
    assert sensor.latest is reading
    assert sensor.poll() == ()
    frames.running = False
    with pytest.raises(FrameTimeout, match=r"no frame within 0\.5 s"):
        sensor.read(0.5)


def test_start_forgets_the_zero(sensor, frames) -> None:
    assert sensor.tare_result is not None
    assert sensor.start() is IDENTITY
    assert sensor.tare_result is None
    assert not readings(sensor, frames, 5)[-1].ok
    assert sensor.layout is LAYOUT
    sensor.stop()
    assert frames.closed


# --- tare ----------------------------------------------------------------------------------------


def test_tare_finds_the_mean_of_the_noise() -> None:
    sensor, _ = make()
    result = sensor.tare(100)
    assert (result.n_frames, result.offset_counts.mean()) == (100, pytest.approx(7.85, abs=0.1))
    assert np.abs(result.offset_counts - 7.85).max() < 2.5
    assert result.noise_counts.mean() == pytest.approx(5.4, abs=0.2)
    assert not result.health.bad.any()
    assert result.health.noisy


INNER = {"press": (0.0,), "counts": 0.0, "dead": 0}
"""What is wrong with the inner pad of finger 0: a press, counts more, dead taxels."""


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"press": (0.4,)}, r"reads .* more than the rest of its pad.*something touches"),
        ({"press": (4.0, "flat")}, r"reads .* counts, allowed are 30\.6"),
        ({"counts": 60.0}, "finger0.inner row"),
        ({"counts": 6.0}, r"finger0\.inner reads .* that nothing grips, allowed are 4\.1"),
        ({"dead": 10}, r"16% of the taxels of pad finger0\.inner are bad \(10 dead, 0 stuck"),
    ],
)
def test_a_tare_under_load_or_on_broken_taxels_is_refused(sensor, frames, wrong, says) -> None:
    before, wrong = sensor.tare_result, INNER | wrong
    frames.press(*wrong["press"])
    frames.base[:64] += wrong["counts"]
    frames.stuck = dict.fromkeys(range(wrong["dead"]), 0)
    with pytest.raises(TareRefused, match=says):
        sensor.tare(30)
    assert sensor.tare_result is before


def test_a_tare_while_the_counts_drift_is_refused() -> None:
    sensor, frames = make()

    def drift(counts: np.ndarray) -> None:
        counts[:64] += np.uint16(frames.counter // 5)

    frames.alter = drift
    with pytest.raises(TareRefused, match=r"moved by .* while the zero was taken"):
        sensor.tare(100)


def test_a_tare_without_frames_times_out_with_their_number() -> None:
    sensor, frames = make()
    frames.sleep(0.5)
    frames.running = False
    with pytest.raises(FrameTimeout, match="0 of 100 frames for the tare, none within 1 s"):
        sensor.tare(100, timeout_s=1.0)


def test_too_few_frames_for_a_tare_are_refused() -> None:
    frames = np.zeros((7, 408), dtype=np.uint16)
    with pytest.raises(TareRefused, match="7 frames"):
        compute_tare(Neighbourhood(LAYOUT), frames, SensorSettings(), 0.0)


def test_a_few_bad_taxels_are_masked_and_filled() -> None:
    sensor, frames = make()
    frames.stuck = {3: 0, 100: 77, 300: 255}
    result = sensor.tare()
    kinds = {kind: np.flatnonzero(mask).tolist() for kind, mask in result.health.kinds.items()}
    assert kinds == {"dead": [3], "stuck": [100], "at full scale": [300]}
    assert np.all(np.abs(result.offset_counts[[3, 100, 300]] - 7.9) < 1.5)


def test_without_noise_dead_taxels_cannot_be_told() -> None:
    frames = np.zeros((20, 408), dtype=np.uint16)
    frames[:, 9] = 255
    health = assess_health(frames, 255)
    assert not health.noisy
    assert np.flatnonzero(health.bad).tolist() == [9]
    assert health.summary() == "0 dead, 0 stuck, 1 at full scale"


@pytest.mark.parametrize("noise_counts", [0.03, 0.1, 0.3])
def test_taxels_whose_noise_is_less_than_a_count_are_not_stuck(noise_counts: float) -> None:
    draw = np.random.default_rng(6)
    offsets = draw.uniform(20.0, 30.0, 408)
    frames = np.rint(offsets + draw.normal(0.0, noise_counts, (100, 408))).astype(np.uint16)
    health = assess_health(frames, 255)
    assert not health.bad.any()
    assert health.noisy is (noise_counts > 0.05), "else frozen samples are not found"


# -- Counts to forces, and the filters between: the paper's figures, borders, noise, single frames -


HOOD = Neighbourhood(LAYOUT)
N = LAYOUT.n_taxels


def taxel(row: int, column: int) -> int:
    return row * 4 + column


def mask(*taxels: int) -> np.ndarray:
    result = np.zeros(N, dtype=bool)
    result[list(taxels)] = True
    return result


def test_spatial_mean_is_binomial_inside() -> None:
    values = np.zeros(N)
    values[taxel(8, 1)] = 16.0
    smooth = HOOD.mean(values)
    assert [smooth[taxel(8, c)] for c in (0, 1, 2, 3)] == pytest.approx([16 * 2 / 12, 4, 2, 0])
    assert smooth[taxel(7, 2)] == pytest.approx(1.0)


def test_nothing_reaches_across_pads() -> None:
    values = np.zeros(N)
    values[LAYOUT.taxels_of(0)] = 5.0
    other = np.ones(N, dtype=bool)
    other[LAYOUT.taxels_of(0)] = False
    assert not HOOD.mean(values)[other].any()
    assert not HOOD.highest_neighbour(values)[other].any()
    np.testing.assert_array_equal(HOOD.connected(mask(0), np.ones(N, dtype=bool)), ~other)


def test_bad_taxels_take_their_neighbours_mean() -> None:
    values = np.arange(N, dtype=float)
    broken = values.copy()
    broken[[taxel(5, 1), taxel(9, 2)]] = [0.0, 255.0]
    np.testing.assert_allclose(fill_bad(HOOD, broken, mask(taxel(5, 1), taxel(9, 2))), values)
    assert fill_bad(HOOD, values, mask()) is values


def test_a_bad_taxel_without_good_neighbours_is_zero() -> None:
    assert not fill_bad(HOOD, np.full(N, 9.0), np.ones(N, dtype=bool)).any()


def test_regions_grow_through_allowed_taxels_only() -> None:
    seed = mask(taxel(2, 0))
    allowed = mask(taxel(2, 0), taxel(3, 1), taxel(4, 2), taxel(7, 0))
    region = HOOD.connected(seed, allowed)
    np.testing.assert_array_equal(region, mask(taxel(2, 0), taxel(3, 1), taxel(4, 2)))
    assert not HOOD.connected(mask(taxel(9, 0)), allowed).any()


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda: ActiveTaxels(HOOD, np.zeros(N)), ValueError, "above 0"),
        *(
            (partial(law, *values), CalibrationError, "gains")
            for gain in (0.0, -1.0, float("nan"), [1.0, float("inf")])
            for law, values in (
                (FoamCalibration, (255, gain)),
                (TableCalibration, ((1.0,), (1.0,), 255, gain)),
            )
        ),
        (lambda: FoamCalibration(0), CalibrationError, "adc_max is 0"),
        (lambda: TableCalibration((1.0,), (1.0,), 0), CalibrationError, "adc_max is 0"),
        *(
            (partial(TableCalibration, *nodes, 255), CalibrationError, "rise from above 0")
            for nodes in (
                ((), ()),
                ((5.0, 3.0), (1.0, 2.0)),
                ((3.0, 5.0), (1.0, 1.0)),
                ((0.0,), (1.0,)),
            )
        ),
    ],
)
def test_what_cannot_be_is_refused(make, error, says) -> None:
    with pytest.raises(error, match=says):
        make()


def touched_by(touch: ActiveTaxels, peak: float) -> set[int]:
    counts = np.zeros(N)
    counts[taxel(8, 1)] = peak
    return set(np.flatnonzero(touch.step(counts)))


def test_touch_starts_high_and_ends_low() -> None:
    # One taxel of 16 counts is 4 counts after smoothing; the noise there is 0.375.
    touch = ActiveTaxels(HOOD, np.ones(N))
    assert touched_by(touch, 5.0 * 0.375 * 4) == set()
    assert taxel(8, 1) in touched_by(touch, 6.0 * 0.375 * 4)
    assert taxel(8, 1) in touched_by(touch, 3.5 * 0.375 * 4)
    assert touched_by(touch, 1.0 * 0.375 * 4) == set()
    assert touched_by(touch, 5.0 * 0.375 * 4) == set()


def test_a_light_flat_touch_is_seen_at_the_large_scale() -> None:
    touch = ActiveTaxels(HOOD, np.ones(N))
    counts = np.zeros(N)
    counts[[taxel(r, c) for r in range(6, 11) for c in range(4)]] = 1.9
    assert np.all(HOOD.mean(counts)[taxel(8, 1)] / 0.375 < 5.5)
    assert touch.step(counts)[taxel(8, 1)]


def test_equation_11_gives_the_papers_curve_from_zero_to_full_scale() -> None:
    # Resistances of the paper's sensor in MOhm: the first term of its equation alone.
    resistance = np.array([1.579, 0.643, 0.262, 0.107, 0.0435])
    for adc_max, gain in ((255, 1.0), (4095, 2.0)):
        force_n = FoamCalibration(adc_max, gain).force_n(adc_max * (1 - resistance / 1.579))
        np.testing.assert_allclose(force_n, gain * np.arange(0.0, 9.0, 2.0), rtol=1e-3)


def test_law_is_smooth_and_rising_through_zero() -> None:
    force_n = FoamCalibration(255).force_n(np.arange(-20.0, 255.0))
    steps = np.diff(force_n)
    assert np.all(steps > 0)
    assert steps[19] == pytest.approx(steps[20], rel=0.01)
    assert force_n[20] == 0.0


def test_full_scale_gives_the_smallest_force_that_saturates() -> None:
    calibration = FoamCalibration(255)
    force_n = calibration.force_n(np.array([254.5, 255.0, 400.0]))
    np.testing.assert_allclose(force_n, 13.88, atol=0.01)
    assert calibration.force_n(np.array([254.4])) < force_n[0] - 0.1


def test_a_table_goes_straight_from_node_to_node_and_on_beyond_them() -> None:
    line = TableCalibration((500.0,), (1.0,), 4095)
    assert line.force_n(np.array([-10.0, 0.0, 500.0])) == pytest.approx([-0.02, 0, 1.0])
    law = TableCalibration((10.0, 30.0), (0.1, 0.7), 255, np.array([1.0, 2.0]))
    assert law.force_n(np.array([5.0, 5.0])) == pytest.approx([0.05, 0.1])
    assert law.force_n(np.array([20.0, 40.0])) == pytest.approx([0.4, 2.0])
    assert law.force_n(np.array([-5.0, 0.0])) == pytest.approx([-0.05, 0.0])


# -- Forces on the taxels of single frames: the sensor's law and zero, without its mean ------------


LAW = FoamCalibration(adc_max=LAYOUT.adc_max)
DEAD = 27
"""A taxel in the middle of the pressed ones."""


@pytest.fixture
def untouched() -> np.ndarray:
    """Forty frames of noise about an offset, with one dead taxel."""
    rng = np.random.default_rng(3)
    counts = np.clip(np.rint(rng.normal(6.0, 1.5, (40, LAYOUT.n_taxels))), 0, 255)
    counts[:, DEAD] = 0
    return counts.astype(np.uint16)


@pytest.fixture
def forces(untouched: np.ndarray) -> TaxelForces:
    zero = compute_tare(Neighbourhood(LAYOUT), untouched, SensorSettings(), 0.0)
    return TaxelForces(LAYOUT, LAW, zero)


def pressed(untouched: np.ndarray, force_n: float) -> np.ndarray:
    """Return a frame with a force on each of 5 x 3 taxels around the dead one."""
    taxels = [DEAD + 4 * row + column for row in range(-2, 3) for column in (-1, 0, 1)]
    counts = untouched[0].astype(float)
    counts[taxels] += counts_of(LAW, np.full(len(taxels), force_n))
    counts[DEAD] = 0
    return np.rint(counts).astype(np.uint16)


def test_untouched_pads_show_no_force(forces, untouched) -> None:
    forces_n = np.array([forces.of(frame) for frame in untouched])
    assert forces_n.dtype == np.float32
    assert np.count_nonzero(forces_n) < 1e-3 * forces_n.size


def test_a_press_shows_its_force_beside_and_on_a_dead_taxel(forces, untouched) -> None:
    pressed_n = forces.of(pressed(untouched, 0.5))
    assert pressed_n.sum() == pytest.approx(15 * 0.5, rel=0.1)
    assert (pressed_n[DEAD], pressed_n[64:].max()) == (pytest.approx(0.5, rel=0.1), 0.0)


def test_a_frame_shows_nothing_of_the_one_before(forces, untouched) -> None:
    alone_n = forces.of(untouched[1])
    forces.of(pressed(untouched, 0.5))
    np.testing.assert_array_equal(forces.of(untouched[1]), alone_n)
