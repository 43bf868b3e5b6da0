"""The unit's sum of the force on its gripping pads."""

from dataclasses import replace

import numpy as np
import pytest

from simulator.can.faults import ControlUnitFaults
from simulator.can.pad_forces import PadForces
from tactile.frames.force_message import decode_force_message, encode_zero
from tactile.layout import TaxelLayout, paper_layout, pinch_layout
from tactile.sensor.calibration import Calibration, FoamCalibration, LinearCalibration
from tactile.sensor.opening import force_table
from tactile.source import ForceMessage, ForceStatus

LAYOUTS = [
    (paper_layout(), FoamCalibration(255)),
    (pinch_layout(), LinearCalibration(force_per_count_n=0.002, adc_max=4095)),
]


class Unit:
    """A unit whose pads are zeroed, and a way to press them."""

    def __init__(
        self, layout: TaxelLayout, calibration: Calibration, *, bad: tuple[int, ...] = ()
    ) -> None:
        self.layout = layout
        self.calibration = calibration
        self.n = sum(layout.pads[pad].n_taxels for pad in layout.gripping_pads)
        self.zero = np.full(self.n, 10.0)
        self.forces = PadForces(layout)
        self.forces.take_table(force_table(layout, calibration))
        dead = np.isin(np.arange(self.n), bad)
        self.forces.take_zero(encode_zero(0.016 * layout.adc_max, self.zero, dead, layout.adc_max))

    def press(self, taxel_n: dict[int, float], scans: int = 40) -> ForceMessage:
        force_n = np.zeros(self.layout.n_taxels)
        force_n[list(taxel_n)] = list(taxel_n.values())
        counts = np.rint(self.calibration.counts(force_n)[: self.n] + self.zero)
        for _ in range(scans):
            data = self.forces.message(counts.astype(np.uint16), ForceStatus(0))
        return decode_force_message(data, 0.0)


@pytest.mark.parametrize(("layout", "calibration"), LAYOUTS, ids=["paper", "pinch"])
def test_the_sum_is_the_force_though_the_counts_are_not_linear(layout, calibration) -> None:
    unit = Unit(layout, calibration)
    columns = layout.pads[layout.gripping_pads[0]].columns
    n_first = layout.pads[layout.gripping_pads[0]].n_taxels
    middle = 5 * columns + 1
    pressed = {middle: 2.0, middle + 1: 1.0, n_first + middle: 2.5, n_first + middle + 1: 0.5}
    found = unit.press(pressed, scans=20)
    assert found.status == ForceStatus.ZEROED
    assert found.force_n == pytest.approx((3.0, 3.0), abs=0.06)
    rows = layout.pads[layout.gripping_pads[0]].rows
    along = 5 - 0.5 * (rows - 1)
    across = (1.0 * 4.5 + 2.0 * 1.5) / 6.0 - 0.5 * (columns - 1)
    assert found.centre_taxels == pytest.approx((along, across), abs=0.08)


def test_a_touch_counts_within_a_few_scans_and_ends_with_the_load() -> None:
    unit = Unit(*LAYOUTS[0])
    touch = dict.fromkeys((20, 21, 24, 25, 28, 29), 0.1)
    seen_n = [unit.press(touch, scans=1).force_n[0] for _ in range(6)]
    assert seen_n[0] == 0.0
    assert seen_n[5] == pytest.approx(0.6, abs=0.05)
    assert unit.press({}, scans=30).force_n == (0.0, 0.0)
    assert unit.press({}, scans=1).centre_taxels is None


def test_a_touch_on_both_pads_counts_sooner_than_one_on_a_single_pad() -> None:
    one = dict.fromkeys((20, 21, 24, 25, 28, 29), 0.05)
    n_first = Unit(*LAYOUTS[0]).n // 2
    both = one | {n_first + taxel: force_n for taxel, force_n in one.items()}

    def counts_after(touch: dict[int, float]) -> int:
        unit = Unit(*LAYOUTS[0])
        return next(n for n in range(1, 40) if unit.press(touch, scans=1).force_n[0] > 0.0)

    assert 1 < counts_after(both) < counts_after(one)


def test_noise_of_untouched_pads_is_no_force() -> None:
    unit = Unit(*LAYOUTS[0])
    rng = np.random.default_rng(3)
    for _ in range(3000):
        noise = np.clip(np.abs(10.0 * rng.standard_normal(unit.n)), 1.0, 20.0) - 8.0
        counts = np.rint(unit.zero + noise).astype(np.uint16)
        found = decode_force_message(unit.forces.message(counts, ForceStatus(0)), 0.0)
        assert found.force_n == (0.0, 0.0)


def test_neighbours_stand_in_for_a_taxel_that_fails() -> None:
    whole, lame = Unit(*LAYOUTS[0]), Unit(*LAYOUTS[0], bad=(21,))
    touch = dict.fromkeys((16, 17, 18, 20, 21, 22, 24, 25, 26), 0.5)
    even_n = whole.press(touch).force_n[0]
    assert lame.press(touch | {21: 0.0}).force_n[0] == pytest.approx(even_n, rel=0.1)


def test_a_unit_without_table_or_zero_says_so_and_full_scale_too() -> None:
    layout, calibration = LAYOUTS[0]
    unit = Unit(layout, calibration)
    assert unit.press({4: 60.0}).status & ForceStatus.SATURATED
    assert not Unit(layout, calibration, bad=(4,)).press({4: 60.0}).status & ForceStatus.SATURATED
    unit.forces.reset()
    found = unit.press({4: 1.0})
    assert (found.status, found.force_n) == (ForceStatus(0), (0.0, 0.0))


@pytest.mark.parametrize(
    ("knobs", "force_n", "centre"),
    [
        ({}, (2.0, 4.0), (1.0, 2.0)),
        ({"force_gain": 0.5, "force_offset_n": 1.0}, (2.0, 3.0), (1.0, 2.0)),
        ({"centre_shift_taxels": 3.0}, (2.0, 4.0), (4.0, 2.0)),
        ({"centres_off": True}, (2.0, 4.0), None),
    ],
)
def test_faults_change_force_and_centre_alone(knobs, force_n, centre) -> None:
    sound = ForceMessage(
        t_s=0.0, counter=3, status=ForceStatus.ZEROED, force_n=(2.0, 4.0), centre_taxels=(1.0, 2.0)
    )
    spoilt = ControlUnitFaults(**knobs).spoil(sound)
    assert spoilt == replace(sound, force_n=force_n, centre_taxels=centre)
