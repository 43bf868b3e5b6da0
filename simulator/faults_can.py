"""Named faults of the CAN link."""

from simulator.faults_entry import (
    Effect,
    FaultEntry,
    FaultKind,
    Number,
    Target,
    nothing,
    share_fault,
    switching,
    turned,
    turning,
    unplugging,
)

_BURST_PERIOD_S = 0.5
_EMERGENCY_BASE = 0x80


def _bursts(target: Target) -> Effect:
    faults, began_s, share = target.devices.faults.can, target.now_s, target.number

    def act(now_s: float) -> None:
        in_burst = (now_s - began_s) % _BURST_PERIOD_S < share * _BURST_PERIOD_S
        faults.drop_rate = 1.0 if in_burst else 0.0

    undo = turned(faults, "drop_rate", 1.0 if share else 0.0)
    return Effect(undo=undo, act=act)


def _short_emergency(target: Target) -> Effect:
    devices = target.devices
    identifier = _EMERGENCY_BASE + devices.settings.node_id
    devices.can_devices.send(target.now_s, identifier, [b"\x10\x81\x01"])
    return Effect(undo=nothing)


def _share(name: str, kind: FaultKind, meaning: str, knob: str) -> FaultEntry:
    return share_fault(name, kind, meaning, knob, turning("can", knob))


def _hertz(default: float) -> Number:
    return Number(unit="Hz", low=0.1, high=20_000.0, default=default)


CAN = (
    _share("can.loss", FaultKind.INTERMITTENT, "messages to the host are lost", "drop_rate"),
    FaultEntry(
        name="can.intermittent",
        kind=FaultKind.INTERMITTENT,
        meaning="all messages to the host are lost in this share of each half second",
        value=Number(unit="share", low=0.0, high=1.0, default=0.2),
        apply=_bursts,
        knob="drop_rate",
    ),
    _share("can.duplicate", FaultKind.WRONG, "messages come twice", "duplicate_rate"),
    _share("can.swapped", FaultKind.WRONG, "messages come after their successor", "swap_rate"),
    _share("can.garbage", FaultKind.GARBAGE, "one bit turns behind the CRC", "corrupt_rate"),
    _share("can.short", FaultKind.GARBAGE, "fewer bytes than the length code", "truncate_rate"),
    _share("can.wrong_dlc", FaultKind.WRONG, "messages of another length", "wrong_dlc_rate"),
    FaultEntry(
        name="can.delayed",
        kind=FaultKind.DELAYED,
        meaning="messages to the host come late",
        value=Number(unit="s", low=0.0, high=60.0, default=0.1),
        apply=turning("can", "delay_s"),
        knob="delay_s",
    ),
    FaultEntry(
        name="can.flood",
        kind=FaultKind.GARBAGE,
        meaning="messages of an unknown identifier with random content fill the bus",
        value=_hertz(8000.0),
        apply=turning("can", "flood_hz"),
        knob="flood_hz",
    ),
    FaultEntry(
        name="can.unknown_id",
        kind=FaultKind.WRONG,
        meaning="now and then a message of an unknown identifier",
        value=_hertz(20.0),
        apply=turning("can", "flood_hz"),
        knob="flood_hz",
    ),
    FaultEntry(
        name="can.short_emergency",
        kind=FaultKind.WRONG,
        meaning="an emergency message of three bytes instead of eight",
        apply=_short_emergency,
        moment=True,
    ),
    FaultEntry(
        name="can.passive",
        kind=FaultKind.SLOW,
        meaning="the host's controller is error-passive",
        apply=switching("can", "error_passive"),
        knob="error_passive",
    ),
    FaultEntry(
        name="can.off",
        kind=FaultKind.OFF,
        meaning="the host's controller is bus-off: nothing passes",
        apply=switching("can", "bus_off"),
        knob="bus_off",
    ),
    FaultEntry(
        name="can.unplugged",
        kind=FaultKind.UNPLUGGED,
        meaning="the host's adapter is gone",
        apply=unplugging("can"),
        knob="can_plug",
    ),
)
