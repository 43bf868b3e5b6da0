"""Named faults of the control unit and its taxels."""

import numpy as np

from simulator.errors import SimulatorSettingsError
from simulator.faults_entry import (
    SHARE,
    Effect,
    FaultEntry,
    FaultKind,
    Number,
    Setting,
    Target,
    nothing,
    switching,
    turned,
    turning,
)
from tactile import eds

_NMT_PREOPERATIONAL = 128
_IDENTITY = {
    "vendor": (eds.IDENTITY, eds.IDENTITY_VENDOR),
    "product": (eds.IDENTITY, eds.IDENTITY_PRODUCT),
    "revision": (eds.IDENTITY, eds.IDENTITY_REVISION),
    "serial": (eds.IDENTITY, eds.IDENTITY_SERIAL),
    "taxels": (eds.LAYOUT, eds.LAYOUT_TAXELS),
    "pads": (eds.LAYOUT, eds.LAYOUT_PADS),
}


def _emergency(target: Target) -> Effect:
    target.devices.unit.emergency(int(target.number))
    return Effect(undo=nothing)


def _reboot(target: Target) -> Effect:
    target.devices.unit.power_cycle()
    return Effect(undo=nothing)


def _pre_operational(target: Target) -> Effect:
    command = bytes((_NMT_PREOPERATIONAL, target.devices.settings.node_id))
    target.devices.unit.receive(0, command, target.now_s)
    return Effect(undo=nothing)


def _check_identity(target: Target) -> None:
    name, number = target.setting
    if name not in _IDENTITY:
        raise SimulatorSettingsError(
            f"unit.wrong takes one of {', '.join(_IDENTITY)} and a number; got {name!r}"
        )
    if not 0 <= number < 2**32:
        raise SimulatorSettingsError(f"unit.wrong: {number} is no number of 32 bits")


def _wrong_identity(target: Target) -> Effect:
    name, number = target.setting
    dictionary = target.devices.unit.dictionary
    index, subindex = _IDENTITY[name]
    before = dictionary.pretend(index, subindex, number)

    def undo() -> None:
        dictionary.pretend(index, subindex, before)

    return Effect(undo=undo)


def _second_node(target: Target) -> Effect:
    devices = target.devices
    return Effect(undo=devices.can_devices.add(devices.second_unit(target.now_s)))


def _some_taxels(target: Target) -> list[int]:
    n_taxels = target.devices.settings.layout.n_taxels
    order = np.random.default_rng(target.devices.settings.seed).permutation(n_taxels)
    return [int(taxel) for taxel in order[: round(target.number * n_taxels)]]


def _stuck_taxels(target: Target) -> Effect:
    full = target.devices.settings.layout.adc_max
    stuck = dict.fromkeys(_some_taxels(target), full)
    return Effect(undo=turned(target.devices.faults.unit, "stuck_counts", stuck))


def _dead_taxels(target: Target) -> Effect:
    dead = set(_some_taxels(target))
    return Effect(undo=turned(target.devices.faults.unit, "dead_taxels", dead))


def _check_pad(target: Target) -> None:
    layout = target.devices.settings.layout
    if target.number >= layout.n_pads:
        raise SimulatorSettingsError(f"taxels.saturated: pads are 0 to {layout.n_pads - 1}")


def _saturated_pad(target: Target) -> Effect:
    layout = target.devices.settings.layout
    pad = int(target.number)
    taxels = range(layout.n_taxels)[layout.taxels_of(pad)]
    full = dict.fromkeys(taxels, layout.adc_max)
    return Effect(undo=turned(target.devices.faults.unit, "stuck_counts", full))


UNIT = (
    FaultEntry(
        name="unit.off",
        kind=FaultKind.OFF,
        meaning="the control unit neither hears nor says anything",
        apply=switching("unit", "dead"),
        knob="dead",
    ),
    FaultEntry(
        name="unit.heartbeat_off",
        kind=FaultKind.OFF,
        meaning="the heartbeat stops, all else goes on",
        apply=switching("unit", "heartbeat_off"),
        knob="heartbeat_off",
    ),
    FaultEntry(
        name="unit.stuck",
        kind=FaultKind.STUCK,
        meaning="valid frames with the counts of the last scan for ever",
        apply=switching("unit", "frozen"),
        knob="frozen",
    ),
    FaultEntry(
        name="unit.slow",
        kind=FaultKind.SLOW,
        meaning="the burst of a frame begins late after its SYNC",
        value=Number(unit="s", low=0.0, high=1.0, default=0.008),
        apply=turning("unit", "late_s"),
        knob="late_s",
    ),
    FaultEntry(
        name="unit.reboot",
        kind=FaultKind.REBOOT,
        meaning="the unit loses its supply and boots anew",
        apply=_reboot,
        moment=True,
    ),
    FaultEntry(
        name="unit.emergency",
        kind=FaultKind.WRONG,
        meaning="the unit reports an error (EMCY)",
        value=Number(unit="code", low=0, high=0xFFFF, default=0x5000, whole=True),
        apply=_emergency,
        moment=True,
    ),
    FaultEntry(
        name="unit.pre_operational",
        kind=FaultKind.OFF,
        meaning="the unit falls back to pre-operational, as on another master's command",
        apply=_pre_operational,
        moment=True,
    ),
    FaultEntry(
        name="unit.wrong",
        kind=FaultKind.WRONG,
        meaning="the unit is another one (vendor, product, revision, serial, taxels, pads)",
        check=_check_identity,
        value=Setting(unit="name:number", default="serial:99"),
        apply=_wrong_identity,
        knob="identity",
    ),
    FaultEntry(
        name="unit.second_node",
        kind=FaultKind.WRONG,
        meaning="another unit with the same node id joins the bus",
        apply=_second_node,
        knob="second_node",
    ),
    FaultEntry(
        name="unit.pads_swapped",
        kind=FaultKind.WRONG,
        meaning="the pads of the two fingers are exchanged at the unit",
        apply=switching("unit", "pads_swapped"),
        knob="pads_swapped",
    ),
)

TAXELS = (
    FaultEntry(
        name="taxels.stuck",
        kind=FaultKind.STUCK,
        meaning="this share of the taxels reads full scale",
        value=SHARE,
        apply=_stuck_taxels,
        knob="stuck_counts",
    ),
    FaultEntry(
        name="taxels.off",
        kind=FaultKind.OFF,
        meaning="this share of the taxels reads 0",
        value=SHARE,
        apply=_dead_taxels,
        knob="dead_taxels",
    ),
    FaultEntry(
        name="taxels.saturated",
        kind=FaultKind.STUCK,
        meaning="all taxels of this pad read full scale",
        value=Number(unit="pad", low=0, high=1000, default=0, whole=True),
        apply=_saturated_pad,
        check=_check_pad,
        knob="stuck_counts",
    ),
    FaultEntry(
        name="taxels.offset",
        kind=FaultKind.WRONG,
        meaning="so many counts come on top of each taxel",
        value=Number(unit="counts", low=-65_535.0, high=65_535.0, default=20.0),
        apply=turning("unit", "offset_counts"),
        knob="offset_counts",
    ),
    FaultEntry(
        name="taxels.gain",
        kind=FaultKind.WRONG,
        meaning="each taxel reads so many times its counts",
        value=Number(unit="factor", low=0.0, high=100.0, default=0.5),
        apply=turning("unit", "gain"),
        knob="gain",
    ),
)
