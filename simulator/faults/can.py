"""Named faults of the CAN link, of the control unit and of its taxels."""

import re
from collections.abc import Iterable

import numpy as np

from simulator.errors import SimulatorSettingsError
from simulator.faults.entry import (
    SHARE,
    FaultEntry,
    FaultKind,
    Number,
    Setting,
    Target,
    Undo,
    knob_fault,
    turned,
    unplugging,
)
from tactile.control_unit import object_dictionary


def _lose_next(target: Target) -> None:
    target.devices.faults.can.drop_next += int(target.number)


# fmt: off
CAN = (
    knob_fault("can.loss", FaultKind.INTERMITTENT, "messages to the host are lost", "drop_rate",
               SHARE),
    FaultEntry("can.lose_next", FaultKind.INTERMITTENT,
               "this number of messages to the host is lost", _lose_next,
               value=Number("messages", 1, 100_000, default=1, whole=True), moment=True),
    knob_fault("can.duplicate", FaultKind.WRONG, "messages come twice", "duplicate_rate", SHARE),
    knob_fault("can.swapped", FaultKind.WRONG, "messages come after their successor", "swap_rate",
               SHARE),
    knob_fault("can.garbage", FaultKind.GARBAGE, "one bit flips after the CRC check",
               "corrupt_rate", SHARE),
    knob_fault("can.short", FaultKind.GARBAGE, "fewer bytes than the length code", "truncate_rate",
               SHARE),
    knob_fault("can.wrong_dlc", FaultKind.WRONG, "messages of another length", "wrong_dlc_rate",
               SHARE),
    knob_fault("can.delayed", FaultKind.DELAYED, "messages to the host come late", "delay_s",
               Number("s", 0.0, 60.0, default=0.1)),
    knob_fault("can.flood", FaultKind.GARBAGE,
               "messages of an unknown identifier with random content come at this rate",
               "flood_hz", Number("Hz", 0.1, 20_000.0, default=8000.0)),
    knob_fault("can.passive", FaultKind.SLOW, "the host's controller is error-passive",
               "error_passive"),
    knob_fault("can.off", FaultKind.OFF, "the host's controller is bus-off: nothing passes",
               "bus_off"),
    FaultEntry("can.unplugged", FaultKind.UNPLUGGED, "the host's adapter is unplugged",
               unplugging("can"), "can_plug"),
)
# fmt: on


_IDENTITY = {
    "vendor": (object_dictionary.IDENTITY, object_dictionary.IDENTITY_VENDOR),
    "product": (object_dictionary.IDENTITY, object_dictionary.IDENTITY_PRODUCT),
    "revision": (object_dictionary.IDENTITY, object_dictionary.IDENTITY_REVISION),
    "serial": (object_dictionary.IDENTITY, object_dictionary.IDENTITY_SERIAL),
    "taxels": (object_dictionary.LAYOUT, object_dictionary.LAYOUT_TAXELS),
    "pads": (object_dictionary.LAYOUT, object_dictionary.LAYOUT_PADS),
}
"""Names for ``unit.wrong``, and the object of each name."""
_PAD = Number("pad", 0, 1000, default=0, whole=True)
"""Number of a pad in the layout."""
_TAXELS = re.compile(r"(\d{1,6})(?:-(\d{1,6}))?")
"""One taxel or a range of them, first and last."""


def _check_identity(target: Target) -> None:
    name, number = target.setting
    if name not in _IDENTITY:
        raise SimulatorSettingsError(
            f"unit.wrong takes one of {', '.join(_IDENTITY)} and a number; got {name!r}"
        )
    if not 0 <= number < 2**32:
        raise SimulatorSettingsError(f"unit.wrong: {number} does not fit into 32 bits")


def _pretending(target: Target, place: tuple[int, int], value: int) -> Undo:
    """Replace the value of an object of the unit's dictionary."""
    dictionary = target.devices.unit.dictionary
    before = dictionary.pretend(*place, value)
    return lambda: dictionary.pretend(*place, before)


def _some_taxels(target: Target) -> list[int]:
    n_taxels = target.devices.settings.layout.n_taxels
    order = np.random.default_rng(target.devices.settings.seed).permutation(n_taxels)
    return [int(taxel) for taxel in order[: round(target.number * n_taxels)]]


def _stuck(target: Target, taxels: Iterable[int], counts: int) -> Undo:
    """Set taxels to constant counts; taxels that are already stuck stay so."""
    faults = target.devices.faults.unit
    return turned(faults, "stuck_counts", faults.stuck_counts | dict.fromkeys(taxels, counts))


def _chosen_taxels(target: Target) -> tuple[range, int]:
    """Return the taxels of ``taxels.stuck_at``, and their counts."""
    name, counts = target.setting
    layout = target.devices.settings.layout
    match = _TAXELS.fullmatch(name)
    if match is None:
        raise SimulatorSettingsError(
            "taxels.stuck_at takes one taxel or a range, for example 3:200 or 3-5:200; got "
            f"{name!r:.40}"
        )
    first, last = int(match[1]), int(match[2] or match[1])
    if not (first <= last < layout.n_taxels and 0 <= counts <= layout.adc_max):
        raise SimulatorSettingsError(
            f"taxels.stuck_at: taxels are 0 to {layout.n_taxels - 1}, counts 0 to {layout.adc_max}"
        )
    return range(first, last + 1), counts


def _taxels_of_pad(target: Target) -> range:
    """Return the taxels of the pad in the value; refuses a pad that is not in the layout."""
    layout = target.devices.settings.layout
    if target.number >= layout.n_pads:
        raise SimulatorSettingsError(f"pad {target.number:g}: pads are 0 to {layout.n_pads - 1}")
    return range(layout.n_taxels)[layout.taxels_of(int(target.number))]


# fmt: off
UNIT = (
    knob_fault("unit.off", FaultKind.OFF, "the control unit receives and sends nothing", "dead"),
    knob_fault("unit.heartbeat_off", FaultKind.OFF, "the heartbeat stops, all else goes on",
               "heartbeat_off"),
    knob_fault("unit.stuck", FaultKind.STUCK,
               "valid frames, always with the counts of the last scan", "frozen"),
    FaultEntry("unit.reboot", FaultKind.REBOOT, "the unit loses its supply and reboots",
               lambda target: target.devices.unit.power_cycle(), moment=True),
    FaultEntry("unit.emergency", FaultKind.WRONG, "the unit reports an error (EMCY)",
               lambda target: target.devices.unit.emergency(int(target.number)),
               value=Number("code", 0, 0xFFFF, default=0x5000, whole=True), moment=True),
    FaultEntry("unit.pre_operational", FaultKind.OFF,
               "the unit changes to pre-operational, as by a command of another master",
               lambda target: target.devices.unit.command("PRE-OPERATIONAL", target.now_s),
               moment=True),
    FaultEntry("unit.wrong", FaultKind.WRONG,
               "the unit differs (vendor, product, revision, serial, taxels, pads)",
               lambda target: _pretending(target, _IDENTITY[target.setting[0]], target.setting[1]),
               "identity", Setting(unit="name:number", default="serial:99"), check=_check_identity),
    FaultEntry("unit.second_node", FaultKind.WRONG,
               "another unit with the same node id joins the bus",
               lambda target: target.devices.can_devices.add(
                   target.devices.second_unit(target.now_s)),
               "second_node"),
    knob_fault("unit.pads_swapped", FaultKind.WRONG,
               "the pads of the two fingers are exchanged at the unit", "pads_swapped"),
    knob_fault("unit.forces_off", FaultKind.OFF, "no force messages any more; frames go on",
               "forces_off"),
    knob_fault("unit.forces_lost", FaultKind.INTERMITTENT, "force messages are lost, evenly",
               "forces_lost", SHARE),
    knob_fault("unit.forces_late", FaultKind.DELAYED, "force messages come late", "forces_late_s",
               Number("s", 0.0, 1.0, default=0.02)),
    knob_fault("unit.forces_each", FaultKind.SLOW,
               "only each n-th force message is made; the counter shows no gap", "forces_each",
               Number("messages", 1, 100, default=15, whole=True)),
    knob_fault("unit.force_gain", FaultKind.WRONG,
               "factor on the force in force messages, as by a table of other pads", "force_gain",
               Number("factor", -100.0, 100.0, default=1.6)),
    knob_fault("unit.force_offset", FaultKind.WRONG, "offset of the force messages",
               "force_offset_n", Number("N", -60.0, 60.0, default=-2.0)),
    knob_fault("unit.pads_empty", FaultKind.STUCK, "force messages repeat those of empty pads",
               "pads_empty"),
    knob_fault("unit.centres_stuck", FaultKind.STUCK,
               "the centre of force in the messages does not move", "centres_stuck"),
    knob_fault("unit.centres_off", FaultKind.OFF, "force messages without a centre of force",
               "centres_off"),
    knob_fault("unit.centre_shift", FaultKind.WRONG,
               "the centre of force in the messages is shifted along the fingers",
               "centre_shift_taxels", Number("pitches", -8.0, 8.0, default=1.0)),
)

TAXELS = (
    FaultEntry("taxels.stuck", FaultKind.STUCK, "this share of the taxels reads full scale",
               lambda target: _stuck(target, _some_taxels(target), target.adc_max),
               "stuck_counts", SHARE),
    FaultEntry("taxels.stuck_at", FaultKind.STUCK,
               "one taxel, or a range, reads these counts (0: dead)",
               lambda target: _stuck(target, *_chosen_taxels(target)), "stuck_counts",
               Setting(unit="taxel:counts", default="0:0"), check=_chosen_taxels),
    FaultEntry("taxels.off", FaultKind.OFF, "this share of the taxels reads 0",
               lambda target: _stuck(target, _some_taxels(target), 0), "stuck_counts", SHARE),
    FaultEntry("taxels.saturated", FaultKind.STUCK, "all taxels of this pad read full scale",
               lambda target: _stuck(target, _taxels_of_pad(target), target.adc_max),
               "stuck_counts", _PAD, check=_taxels_of_pad),
    knob_fault("taxels.force_gain", FaultKind.WRONG,
               "factor on the force of each taxel: the law of other foam", "force_gain",
               Number("factor", 0.0, 100.0, default=0.8),
               owner=lambda target: target.devices.physical),
    knob_fault("taxels.offset", FaultKind.WRONG, "counts added to each taxel", "offset_counts",
               Number("counts", -65_535.0, 65_535.0, default=20.0)),
    knob_fault("taxels.gain", FaultKind.WRONG, "factor on the counts of each taxel", "gain",
               Number("factor", 0.0, 100.0, default=0.5)),
)
# fmt: on
