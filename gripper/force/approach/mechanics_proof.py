"""Proof that the fingers move and stop as direction, zero and linkage of the settings predict.

An encoder measures a servo's motion, not that of a finger: with a wrong ``direction`` it reports an
opening while the fingers close, and in free space nothing shows the difference. The geometry shows
it: no pad passes the other one, so that every opening is 0 or more, and the linkage sets both ends
of the travel. The check is made

1. at rest, by `standing_rows`: in a start, in ``doctor``, and before any torque comes on;
2. in the first opening after the torque has come on, by `FirstMotion`: with the least current that
   moves a finger, all the way; a finger that is blocked, but free on its way back, contradicts the
   settings. The torque goes off: nothing can be held;
3. at the first approach after it that finds nothing, and at each self-zero: an approach continued
   with `meeting` must end where the pads stop each other.

A release with its torque just switched on closes no finger, and so tries no way back: closed
fingers that do not move at all get up to 5 N before the torque goes off.

Forces for 60 mm links on XM430-W350 with the friction of their data; o is the ``offset`` of the
linkage, and the numbers are those of the checks above:

============================= ================================== ==================================
wrong setting                 is found by                        largest force on a part between
============================= ================================== ==================================
``direction`` of both, o = 0  1 where they stand 4 mm open or    none; else 2 N
                              more, else 2
``direction`` of one, o = 0   1 where its finger stands 5 mm or  none; else 2 N
                              more from the middle, else 2
zero: reads too closed        1 where the opening is less than   none; 2 N where the pads meet
                              the error; else 3, after a grasp
                              that found nothing
zero: reads too open          2 where the fingers meet on their  2 N; after that the cap of the
                              way; else a touch, or an           approach
                              obstruction, at that opening
``direction`` or length with  as a zero that is off              as there
o not 0
length with o = 0             not by motion: opening and force   that of the force control; the pads
                              by current are scaled, both stops  measure it
                              agree. Gauge a part
============================= ================================== ==================================
"""

from collections.abc import Sequence
from dataclasses import replace

from gripper.errors import GripperError, LimitExceeded, MechanicsContradicted
from gripper.mechanics.kinematics import Linkage
from gripper.mechanics.transmission import Mechanics
from gripper.servos.feedback import BEYOND_CLOSED_M
from gripper.servos.goal_limits import BEYOND_MIDDLE_M
from gripper.values.servo_checks import VerificationRow
from gripper.values.state import ServoFeedback

POSITION_ITEM = "present_position"
"""Name of the rows that `standing_rows` returns."""
ZERO_RANGE_M = 0.006
"""Largest accepted error of the zero of the opening in m, in both directions: empty fingers meet
within it. A tooth of a horn is 15 mm on a link of 60 mm. [chosen]"""
_PADS_GIVE_M = 0.001
"""Yield of two pads that press on each other, in m. [assumed]"""
_LONGER = 3.0
"""Factor on ``contact_timeout_s`` for fingers that close completely. [chosen]"""
LARGEST_MIN_M = 0.002
"""Largest ``aperture_min_m`` in m from which the fingers close farther to find each other.
[chosen]"""


def mechanics_text(mechanics: Mechanics) -> str:
    """Return the keys of the config that determine the motion of the fingers, with values."""
    servos, linkage = mechanics.settings.servos, mechanics.linkage
    directions = ", ".join(str(servo.direction) for servo in servos)
    zeros = ", ".join(str(servo.zero_raw) for servo in servos)
    return (
        f"gripper.servos[].direction ({directions}), gripper.servos[].zero_pulse ({zeros}) and "
        f"gripper.linkage ({linkage})"
    )


def standing_rows(
    mechanics: Mechanics, positions_raw: Sequence[int]
) -> tuple[VerificationRow, ...]:
    """Return for each servo whether its position is possible for its finger.

    Parameters
    ----------
    mechanics
        Of the gripper.
    positions_raw
        Present Position of each servo (register 132).
    """
    settings, linkage = mechanics.settings, mechanics.linkage
    halves_m: list[float | None] = []
    for servo, raw in zip(settings.servos, positions_raw, strict=True):
        halves_m.append(_half_m(linkage, servo.angle_rad(raw, servo.turns(raw))))
    opening_m = sum(half_m for half_m in halves_m if half_m is not None) * (2.0 / len(halves_m))
    closed = opening_m < -BEYOND_CLOSED_M
    rows = []
    for index, (servo, raw, half_m) in enumerate(
        zip(settings.servos, positions_raw, halves_m, strict=True)
    ):
        wrong = half_m is None or half_m < (0.0 if closed else -BEYOND_MIDDLE_M)
        where = "beyond its dead centre" if half_m is None else f"{half_m * 1e3:.1f} mm from it"
        rows.append(
            VerificationRow(
                servo_id=servo.servo_id,
                item=POSITION_ITEM,
                expected="a finger on its own side of the middle",
                actual=f"{where}, opening {opening_m * 1e3:.1f} mm, by the position {raw} and "
                f"gripper.servos[{index}].direction {servo.direction}, zero_pulse "
                f"{servo.zero_raw}, gripper.linkage {linkage}"
                if wrong
                else str(raw),
                ok=not wrong,
            )
        )
    return tuple(rows)


def _half_m(linkage: Linkage, angle_rad: float) -> float | None:
    """Return the distance of a finger from the middle in m; None beyond its dead centre."""
    try:
        linkage.opening_per_rad_m(angle_rad)
    except LimitExceeded:
        return None
    return 0.5 * linkage.of_one_finger().aperture_m((angle_rad,))


def meeting(mechanics: Mechanics) -> Mechanics:
    """Return the mechanics for an approach until the pads of empty fingers meet."""
    settings = replace(
        mechanics.settings,
        aperture_min_m=-(ZERO_RANGE_M + _PADS_GIVE_M),
        aperture_pressed_m=None,
        contact_timeout_s=min(_LONGER * mechanics.settings.contact_timeout_s, 60.0),
    )
    return mechanics.with_settings(settings)


def not_met(mechanics: Mechanics, state: ServoFeedback, advice: str) -> GripperError:
    """Return the error of empty fingers that did not stop where their pads must meet.

    ``mechanics`` is that of `meeting`. If the time ended before, nothing is wrong with it:
    ``advice`` then ends the text.
    """
    settings = mechanics.settings
    if state.aperture_m > settings.aperture_min_m:
        return LimitExceeded(
            f"the empty fingers should meet, but after {settings.contact_timeout_s:g} s they have "
            f"closed to {state.aperture_m * 1e3:.1f} mm only. They stand still: clear the fault "
            f"and release, then raise gripper.contact_timeout_s or gripper.approach_speed_mm_s"
            f"{advice}"
        )
    return MechanicsContradicted(
        f"the fingers have found nothing, and stand at an opening of "
        f"{state.aperture_m * 1e3:.1f} mm, at which the pads must have stopped each other: "
        f"the closed position in the settings is wrong, so the torque is switched off. Look "
        f"at the fingers, then check {mechanics_text(mechanics)}"
    )
