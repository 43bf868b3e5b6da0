"""Impact of closing fingers on a part, and the closing speed up to which the force cap holds.

Motor and finger, seen at the pad, are a mass that meets a spring, the foam of the pad:

    peak force = drive + speed * sqrt(stiffness * mass)

The goal current presses with the drive once friction is overcome. Samples of the pads are not used.
On a hard part the impact is over in pi / 2 * sqrt(mass / stiffness), 12 ms with the defaults. This
is before a sample of the touch, the period that it waits for and the rise of a current. Fingers
stop in time because they are slow enough when they touch.
"""

from collections.abc import Sequence
from math import ceil, exp, inf, sqrt
from typing import NamedTuple

from gripper.dynamixel.drive import SIGMAS
from gripper.errors import LimitExceeded
from gripper.mechanics.transmission import Drives, Mechanics, Transmission
from gripper.settings import GripperSettings
from gripper.values.state import STANDING_M_S

_RESERVE_SHARE = 0.1
"""Share of the cap that is left free: inertia, torque and foam differ from their nominal values.
[chosen]"""
_FINGER_KG_M2 = 2e-4
"""Inertia of a finger and its link about the servo's axis in kg m²: 55 g at 60 mm, assumed. The
motor's inertia behind its gears is 6 to 60 times as large. [assumed]"""
_SMALL_PART_M = 4e-4
"""Twice the energy over the force that a pad absorbs under the smallest parts, in m. Foam of 3 mm
was under spheres and edges of 1 to 10 mm, at 15 to 50 N (simulated foam). A small part is soft at
first and then meets the bottom. Up to 22 N a flat part on the whole default pads is harder.
[simulated]"""
_STOOD_SHARE = 1.1
"""Largest current of a finger over the current at which it stood still. [chosen]"""
SLOWEST_M_S = 2.0 * STANDING_M_S
"""Least rate of the opening in m/s of an approach: twice the rate below which the fingers count as
standing."""

_GOAL_PERIODS = 1.5
"""Worst average number of periods from a position to the goal calculated from the next one.
[chosen]"""
CURRENT_S = 0.003
"""Time constant in s of a servo's current. [assumed]"""
_SLOWED_TIMES = 2.0
"""Time constants after which fingers count as slowed down: 14 % of the difference is left.
[chosen]"""


def current_share(duration_s: float) -> float:
    """Return the share of a new goal that a current has reached after a time in s."""
    return 1.0 - exp(-duration_s / CURRENT_S)


class ImpactLimit(NamedTuple):
    """Largest speed of closing fingers whose momentum stays below the cap of the force."""

    most_n: float
    """Largest force in N of a peak: the cap less the free share."""
    drive_n: float
    """Force in N of the current of an approach."""
    mass_kg: float
    """Moving mass of a finger at the pad, with the motor's behind its gears."""
    momentum_n_s_m: float
    """Force in N that the moving mass adds for each m/s of a pad."""
    load_share: float
    """Largest plausible force of a drive over the nominal one."""

    def pad_speed_m_s(self, force_n: float | None = None) -> float:
        """Return the largest speed of a pad in m/s, with a force in N on it or before the touch."""
        left_n = self.most_n - (self.drive_n if force_n is None else force_n)
        return max(0.0, left_n / self.momentum_n_s_m)


def impact_limit(mechanics: Mechanics, angles_rad: Sequence[float] | None = None) -> ImpactLimit:
    """Return the limit of closing fingers under the cap of the force.

    Parameters
    ----------
    angles_rad
        Angle of each servo in rad; None for the worse end of the way between ``aperture_open_m``
        and ``aperture_min_m``.
    """
    key = (mechanics.drives.version, angles_rad and tuple(angles_rad))
    last: tuple[object, ImpactLimit] | None = mechanics.last_impact
    if last is not None and last[0] == key:
        return last[1]
    settings, linkage = mechanics.settings, mechanics.linkage
    ends_m = (settings.aperture_open_m, settings.aperture_min_m)
    ways = [linkage.angles_rad(end_m) for end_m in ends_m] if angles_rad is None else [angles_rad]
    drive_n = mass_kg = load_share = 0.0
    for way_rad in ways:
        paths = mechanics.transmissions(way_rad)
        try:
            currents_a = mechanics.motion_currents_a(paths, settings.approach_force_n)
        except LimitExceeded:
            # A current below friction moves no finger: the caller of a motion refuses it.
            currents_a = [settings.current_max_a] * len(paths)
        fingers = 2 / len(paths)
        for servo, path, current_a in zip(settings.servos, paths, currents_a, strict=True):
            drive_n = max(drive_n, path.pressing_n(current_a))
            load_share = max(load_share, exp(SIGMAS * path.drive.load_sd))
            servo_kg_m2 = path.drive.inertia_a_s2(servo.servo_model) / path.drive.rising_a_nm
            inertia_kg_m2 = servo_kg_m2 + fingers * _FINGER_KG_M2
            # By virtual work a servo that drives both fingers has half its mass at each pad.
            mass_kg = max(mass_kg, fingers * inertia_kg_m2 / path.radius_m**2)
    stiffness_n_m = max(settings.pad_stiffness_n_m, settings.force_max_n / _SMALL_PART_M)
    limit = ImpactLimit(
        most_n=most_peak_n(settings),
        drive_n=drive_n,
        mass_kg=mass_kg,
        momentum_n_s_m=sqrt(stiffness_n_m * mass_kg),
        load_share=load_share,
    )
    mechanics.last_impact = key, limit
    return limit


def most_peak_n(settings: GripperSettings) -> float:
    """Return the force in N that a peak may reach."""
    return (1.0 - _RESERVE_SHARE) * settings.force_max_n


def closing_current_max_a(
    settings: GripperSettings, path: Transmission, *, stood_a: float = inf
) -> float:
    """Return the current in A with which a closing finger presses with less than the cap.

    A servo that was never measured may need more to move at all. An untouched finger that stood
    still at ``stood_a`` shows its friction, or presses on something that the pads do not show. So
    the cap holds even so, for any plausible torque and at least the catalogue's friction. Without
    ``stood_a`` the friction may be the largest plausible one.
    """
    by_force_a = path.pressing_current_a(most_peak_n(settings))
    if not path.drive.measured:
        more_a = path.drive.breakaway_a - path.drive.least_breakaway_a
        by_force_a = max(by_force_a, min(_STOOD_SHARE * stood_a, by_force_a + more_a))
    return min(settings.current_max_a, by_force_a)


def approach_speed_m_s(
    mechanics: Mechanics, angles_rad: Sequence[float], *, travelling: bool = False
) -> float:
    """Return the rate of the opening in m/s of an approach at an angle of each servo in rad.

    ``travelling`` is True before a part is expected; the force on a part stays below the cap too.
    """
    wanted_m_s = mechanics.settings.approach_speed_m_s
    if travelling:
        wanted_m_s = max(wanted_m_s, mechanics.settings.travel_speed_m_s)
    return min(wanted_m_s, closing_speed_m_s(mechanics, angles_rad))


def closing_speed_m_s(mechanics: Mechanics, angles_rad: Sequence[float]) -> float:
    """Return the largest rate of the opening in m/s of closing fingers, for any commanded rate."""
    # Each of the fingers closes at half the rate of the opening.
    return max(2.0 * impact_limit(mechanics, angles_rad).pad_speed_m_s(), SLOWEST_M_S)


def slowing_way_m(mechanics: Mechanics, begun_rad: Sequence[float], aperture_m: float) -> float:
    """Return the change of the opening in m in which an approach slows down for a part.

    The fingers begin at some angles in rad, and the part may be at an opening in m.

    The goal of a servo is moved back to the lead of the lower speed. Until this acts, the fingers
    go on. Then position control brings the moving mass to that speed with a time constant. Its
    current falls with the speed, as its D gain damps.
    """
    from_m_s = approach_speed_m_s(mechanics, begun_rad, travelling=True)
    to_m_s = approach_speed_m_s(mechanics, begun_rad)
    if to_m_s >= from_m_s:
        return 0.0
    angles_rad = mechanics.linkage.angles_rad(aperture_m)
    settings, paths = mechanics.settings, mechanics.transmissions(angles_rad)
    mass_kg = impact_limit(mechanics, angles_rad).mass_kg
    slowing_s = max(
        mass_kg * path.radius_m / (path.n_per_a * servo.servo_model.damping_a_s)
        for path, servo in zip(paths, settings.servos, strict=True)
    )
    acts_s = _GOAL_PERIODS * settings.period_s + CURRENT_S
    lasts_s = _SLOWED_TIMES * slowing_s
    return acts_s * from_m_s + slowing_s * (from_m_s - to_m_s) + lasts_s * to_m_s


def check_approach(mechanics: Mechanics) -> float:
    """Return the least rate of the opening in m/s on the way of an approach.

    Raises LimitExceeded when no approach can be stopped below the cap of the force.
    """
    # Motions that measure the servos are slower, and come first.
    settings, of = mechanics.settings, mechanics.drives.of
    drives = Drives({servo.servo_id: of(servo).once_measured for servo in settings.servos})
    limit = impact_limit(Mechanics(settings, mechanics.linkage, drives))
    allowed_m_s = 2.0 * limit.pad_speed_m_s()
    if allowed_m_s < SLOWEST_M_S:
        least_n = (limit.drive_n + 0.5 * SLOWEST_M_S * limit.momentum_n_s_m) / (
            1.0 - _RESERVE_SHARE
        )
        raise LimitExceeded(
            f"force_max_n is {settings.force_max_n:g} N: fingers that have just overcome their "
            f"friction press with up to {limit.drive_n:.2f} N, and with their momentum reach "
            f"{least_n:.2f} N even where they close at {1e3 * SLOWEST_M_S:g} mm/s. Raise "
            f"force_max_n to {ceil(10.0 * least_n) / 10.0:g} N, lower approach_force_n, or take "
            f"servos with less friction or longer links"
        )
    return min(settings.approach_speed_m_s, allowed_m_s)
