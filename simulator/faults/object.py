"""Named faults of the object between the fingers."""

from simulator.faults.entry import (
    FaultEntry,
    FaultKind,
    Number,
    Target,
    Undo,
)

_SLIDE_M = 1e-4
"""Step in m of a sliding part: its forces are computed again for each step."""
_SWELLING_M_S = 0.02
"""Growth of a trapped object in m/s: slower than the approach of the fingers."""


def _slips(target: Target) -> Undo:
    world, speed_m_s, last_s = target.devices.physical, 1e-3 * target.number, target.now_s

    def act(now_s: float) -> None:
        nonlocal last_s
        way_m = (now_s - last_s) * speed_m_s
        if way_m >= _SLIDE_M:
            world.slide(way_m)
            last_s = now_s

    target.act = act
    return lambda: None


def _trapped(target: Target) -> Undo:
    world, began_s = target.devices.physical, target.now_s

    def act(now_s: float) -> None:
        grown_m = (now_s - began_s) * _SWELLING_M_S
        world.swell(min(grown_m, 1e-3 * target.number))

    target.act = act
    return lambda: world.swell(0.0)


# fmt: off
OBJECT = (
    FaultEntry("object.gone", FaultKind.OFF, "the part is removed from the fingers",
               lambda target: target.devices.physical.remove(), moment=True),
    FaultEntry("object.slips", FaultKind.WRONG,
               "the part slides along the pads until it has left them", _slips, "slips",
               Number("mm/s", 0.1, 1000.0, default=20.0)),
    FaultEntry("object.trapped", FaultKind.WRONG,
               "a trapped object beside the part grows by this value at 20 mm/s and pushes back",
               _trapped, "trapped", Number("mm", 0.0, 10.0, default=3.0)),
)
# fmt: on
