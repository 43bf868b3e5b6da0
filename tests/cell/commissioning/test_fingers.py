"""Linkages fitted to blocks, directions and zeros found by hand: pure functions."""

from math import asin, radians, sin

import pytest

from cell.commissioning.fingers import (
    Measured,
    directions,
    fit_linkages,
    moved_alone,
    zero_pulse,
)
from gripper.kinematics import ParallelLinkage, RackPinion

BLOCKS_M = (0.010, 0.030)


def on_parallel(size_m: float, link_m: float, closed_rad: float = 0.0) -> Measured:
    angle = asin(size_m / 2 / link_m + sin(closed_rad)) - closed_rad
    return Measured(angles_rad=(angle, angle), aperture_m=size_m)


def test_each_kind_of_linkage_is_found() -> None:
    parallel = fit_linkages([on_parallel(m, 0.03) for m in BLOCKS_M])[0]
    assert (parallel.kind, parallel.residual_m) == ("parallel", pytest.approx(0.0, abs=1e-9))
    assert isinstance(parallel.linkage, ParallelLinkage)
    assert parallel.linkage.link_m == pytest.approx(0.03)

    on_rack = [Measured(angles_rad=(m / 2 / 0.01,), aperture_m=m) for m in BLOCKS_M]
    pinion = fit_linkages(on_rack)[0]
    assert pinion.kind == "pinion"
    assert isinstance(pinion.linkage, RackPinion)
    assert pinion.linkage.pinion_radius_m == pytest.approx(0.01)

    askew = [on_parallel(m, 0.04, radians(35)) for m in BLOCKS_M]
    swinging = fit_linkages(askew)[0]
    assert swinging.kind == "swinging"
    assert swinging.closed_rad == pytest.approx(radians(35), abs=1e-3)
    opening_m = swinging.linkage.aperture_m([swinging.closed_rad + a for a in askew[0].angles_rad])
    assert opening_m == pytest.approx(BLOCKS_M[0], abs=1e-6)
    assert swinging.linkage.aperture_m([swinging.closed_rad] * 2) == pytest.approx(0, abs=1e-6)


def test_one_finger_pushed_off_the_middle_does_not_matter() -> None:
    sides = [(0.010, 0.004), (0.010, 0.020)]
    measured = [
        Measured(angles_rad=(asin(a / 0.06), asin(b / 0.06)), aperture_m=a + b) for a, b in sides
    ]
    fit = fit_linkages(measured)[0]
    assert isinstance(fit.linkage, ParallelLinkage)
    assert fit.linkage.link_m == pytest.approx(0.06, rel=1e-3)


def test_a_wrongly_typed_block_shows_in_the_residual() -> None:
    first, second = (on_parallel(m, 0.06) for m in BLOCKS_M)
    wrong = Measured(angles_rad=second.angles_rad, aperture_m=0.050)
    simple = [fit for fit in fit_linkages([first, wrong]) if fit.kind != "swinging"]
    assert min(fit.residual_m for fit in simple) > 2e-3
    with pytest.raises(ValueError, match="block"):
        fit_linkages([])
    with pytest.raises(ValueError, match="open"):
        fit_linkages([Measured(angles_rad=(-0.1, 0.05), aperture_m=0.01)])


def test_one_block_gives_no_residual_and_proposes_links() -> None:
    fits = fit_linkages([on_parallel(0.03, 0.06)])
    assert [fit.kind for fit in fits] == ["parallel", "pinion"]
    assert all(fit.residual_m < 1e-9 for fit in fits)


def test_directions_and_zero_follow_from_the_hands() -> None:
    assert directions((2048, 2048), (2500, 1700)) == (1, -1)
    with pytest.raises(ValueError, match="50 pulses"):
        directions((2048,), (2098,))
    assert moved_alone((2048, 2048), (2500, 2060)) == 0
    assert moved_alone((2048, 2048), (2048, 1500)) == 1
    assert moved_alone((2048, 2048), (2500, 2300)) is None
    assert moved_alone((2048, 2048), (2050, 2048)) is None
    assert zero_pulse(2100, 1, radians(9)) == 2100 - 102
    assert zero_pulse(2100, -1, radians(9)) == 2100 + 102
