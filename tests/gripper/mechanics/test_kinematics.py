from dataclasses import replace
from math import pi

import pytest
from hypothesis import given, settings, strategies as st

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import XM430_W350
from gripper.errors import LimitExceeded
from gripper.mechanics.kinematics import Linkage, ParallelLinkage, RackPinion
from gripper.mechanics.transmission import Transmission

LINK = ParallelLinkage(link_m=0.06)
OFFSET_M, SERVOS = st.floats(-0.005, 0.005), st.sampled_from([1, 2])
RACK_M = st.floats(0.008, 0.03)
LINKAGES = st.one_of(
    st.builds(ParallelLinkage, link_m=st.floats(0.04, 0.1), offset_m=OFFSET_M, n_servos=SERVOS),
    st.builds(RackPinion, pinion_radius_m=RACK_M, offset_m=OFFSET_M, n_servos=SERVOS),
)


@settings(max_examples=80)
@given(LINKAGES, st.floats(0.0, 0.03))
def test_angle_and_aperture_come_back(linkage: Linkage, aperture_m: float) -> None:
    angles = linkage.angles_rad(aperture_m)
    assert len(angles) == linkage.n_servos
    assert linkage.aperture_m(angles) == pytest.approx(aperture_m, abs=1e-12)


@settings(max_examples=80)
@given(LINKAGES, st.floats(0.0, 0.03))
def test_torque_follows_from_virtual_work(linkage: Linkage, aperture_m: float) -> None:
    angle, h = linkage.angles_rad(aperture_m)[0], 1e-6
    higher = linkage.aperture_m([angle + h] * linkage.n_servos)
    lower = linkage.aperture_m([angle - h] * linkage.n_servos)
    opening_per_servo = (higher - lower) / (2 * h) / linkage.n_servos
    assert linkage.opening_per_rad_m(angle) == pytest.approx(opening_per_servo, rel=1e-5)
    # Both fingers carry F, and the aperture opens by what both move: T dtheta = F d(aperture).
    assert linkage.effective_radius_m(angle) == pytest.approx(opening_per_servo, rel=1e-5)


def test_figures_of_current_and_force() -> None:
    path = Transmission(DriveCharacteristic.catalogue(XM430_W350), 0.06)
    assert path.loaded_n(0.3) == pytest.approx(7.5, abs=0.06)
    assert path.loaded_n(1.0) == pytest.approx(28.5, abs=0.06)
    assert path.friction_n == pytest.approx(0.09 / 0.06)
    assert path.loading_current_a(10.0) == pytest.approx((10 * 0.06 + 0.09) / 1.80)


@settings(max_examples=50)
@given(st.floats(0.0, 30.0), st.floats(0.3, 1.0))
def test_a_force_falls_at_one_drive_and_is_0_at_the_friction(force_n: float, share: float) -> None:
    drive = replace(
        DriveCharacteristic.catalogue(XM430_W350),
        breakaway_a=0.1,
        coulomb_a=0.1,
        rising_a_nm=0.6,
        falling_a_nm=0.3,
        yielding_share=share,
    )
    path = Transmission(drive, 0.05)
    assert path.loaded_n(path.loading_current_a(force_n)) == pytest.approx(force_n, abs=1e-9)
    held_n = share * 0.1 / (0.3 * 0.05)
    for part in (0.0, 0.3, 1.0):
        drive_n = -(1.0 - part) * path.friction_n
        assert path.yielding_n(part * held_n) == pytest.approx(drive_n), "held by the gearing alone"
    falls_a = 0.3 * 0.05 * (held_n + force_n) - share * 0.1
    assert path.yielding_n(held_n + force_n) == pytest.approx(falls_a * path.n_per_a, abs=1e-9)


@pytest.mark.parametrize(
    ("use", "says"),
    [
        (lambda: LINK.angles_rad(0.2), "out of reach"),
        (lambda: LINK.opening_per_rad_m(pi / 2), "dead centre"),
        (lambda: LINK.aperture_m([0.1]), "got 1 angles"),
        (lambda: RackPinion(pinion_radius_m=0.01).angles_rad(0.2), "out of reach"),
        (lambda: ParallelLinkage(link_m=0.0), "link_m"),
        (lambda: RackPinion(pinion_radius_m=0.01, n_servos=3), "n_servos"),
        (lambda: ParallelLinkage(link_m=0.01, offset_m=float("nan")), "offset_m"),
    ],
)
def test_impossible_geometry_is_refused(use, says) -> None:
    with pytest.raises(LimitExceeded, match=says):
        use()
