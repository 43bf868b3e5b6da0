"""Setup of the control unit: checks of its identity and taxels, then its periods and its table."""

from collections.abc import Mapping

from tactile.can.sdo_client import PolledSdoClient
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.settings import WINDOW_SHARE, LinkSettings
from tactile.errors import IdentityMismatch
from tactile.frames import FrameFormat
from tactile.layout import TaxelLayout
from tactile.source import SourceIdentity

_COB_ID_MASK = 0xFFFF_FFFF & ~(1 << 30)
"""Compared bits of a PDO's COB-ID entry: bit 30 only forbids RTR (CiA 301, 7.5.2.37)."""
_COB_IDS = (od.FRAMES_COB_ID, od.FORCES_COB_ID)
_FRAMES_TYPE = (
    "TPDO1 communication parameter.Transmission type (manufacturer-specific: burst after SYNC)"
)
_SYNC_OVERFLOW = "Synchronous counter overflow value"
_CHECK_CONFIG = (
    "Check which unit is plugged in, and the node-ID, serial number and layout in the configuration"
)
_CHECK_STORED = (
    "Write the expected ones with a CANopen tool (1019h while 1006h is 0), store them in the "
    "unit, then start again"
)


Check = tuple[str, int | str | None, int | str]
"""One row of a comparison: name, expected and found value. None as expected accepts anything."""


def read_identity(objects: PolledSdoClient) -> SourceIdentity:
    """Read the identity object, the device name and the boards of the pads."""
    boards = "Serial numbers of the boards.Board of finger"
    return SourceIdentity(
        vendor_id=objects["Identity object.Vendor-ID"].raw,
        product_code=objects["Identity object.Product code"].raw,
        revision=objects["Identity object.Revision number"].raw,
        serial=objects["Identity object.Serial number"].raw,
        name=objects["Manufacturer device name"].raw,
        boards=(objects[f"{boards} 0"].raw, objects[f"{boards} 1"].raw),
    )


def identity_checks(
    identity: SourceIdentity, serial: int | None = None, boards: tuple[int, int] | None = None
) -> list[Check]:
    """Return the comparison of the found identity with that of the EDS, and with given numbers.

    The upper 16 bits of the revision are the behaviour on the bus (CiA 301), the lower may differ.
    """
    return [
        ("vendor-ID", od.VENDOR_ID, identity.vendor_id),
        ("product code", od.PRODUCT_CODE, identity.product_code),
        ("major revision", od.REVISION >> 16, identity.revision >> 16),
        ("serial number", serial, identity.serial),
        *(
            (f"pads' board of finger {finger}", board, identity.boards[finger])
            for finger, board in enumerate(boards or ())
        ),
    ]


def refuse_other_unit(
    objects: PolledSdoClient, layout: TaxelLayout, node_id: int, settings: LinkSettings
) -> SourceIdentity:
    """Return the identity of the unit; IdentityMismatch if it is not the one of the config.

    SYNC is sent without a counter, so a unit with an overflow value answers by emergency 8240h.
    """
    identity, boards = read_identity(objects), settings.boards
    if boards is not None and boards[0] != boards[1] and identity.boards == boards[::-1]:
        raise IdentityMismatch(
            f"the pads of the two fingers are exchanged at {objects.name}: the board of finger 0 "
            f"is {identity.boards[0]}, expected {boards[0]}, that of finger 1 is "
            f"{identity.boards[1]}, expected {boards[1]}. Exchange their cables at the unit, or "
            "correct tactile.board_serial_numbers"
        )
    other = f"{objects.name} is not the configured unit"
    refuse_mismatch(identity_checks(identity, settings.serial, boards), other)
    form = FrameFormat.of(layout)
    expected_numbers = {
        "Taxel layout.Number of taxels": layout.n_taxels,
        "Taxel layout.Full scale of the counts": layout.adc_max,
        "Frame format.Sample bytes": form.sample_bytes,
        "Frame format.Messages per frame": form.n_messages,
        "Frame format.Header bytes": form.header_bytes,
        od.FRAMES_COB_ID: od.COB_TPDO1 + node_id,
        **objects.defaults("TPDO1 mapping parameter"),
    }
    unit_hash = objects["Taxel layout.Layout hash"].raw
    layout_check = ("Layout hash", layout.layout_hash, unit_hash)
    refuse_mismatch([layout_check, *_checks(objects, expected_numbers)], other)
    stored = [
        *_checks(objects, {_FRAMES_TYPE: objects[_FRAMES_TYPE].od.default}),
        (objects.label(_SYNC_OVERFLOW), 0, objects.find(_SYNC_OVERFLOW) or 0),
    ]
    refuse_mismatch(stored, f"{objects.name} has stored values that do not fit", _CHECK_STORED)
    return identity


def _checks(objects: PolledSdoClient, expected: Mapping[str, int]) -> list[Check]:
    """Read unsigned objects, and return them with their expected values."""
    actual = {
        name: objects[name].raw & (_COB_ID_MASK if name in _COB_IDS else -1) for name in expected
    }
    return [(objects.label(name), number, actual[name]) for name, number in expected.items()]


def _in_words(value: int | str | None) -> str:
    return f"{value} (0x{value:X})" if isinstance(value, int) else str(value)


def refuse_mismatch(checks: list[Check], problem: str, advice: str = _CHECK_CONFIG) -> None:
    """Raise IdentityMismatch with expected and found values if any check failed."""
    failed = [
        f"{what}: expected {_in_words(expected)}, found {_in_words(actual)}"
        for what, expected, actual in checks
        if expected not in (None, actual)
    ]
    if failed:
        raise IdentityMismatch(f"{problem}: {'; '.join(failed)}. {advice}")


def written(settings: LinkSettings, node_id: int, *, forces: bool) -> dict[str, int]:
    """Return the numbers that each start of the link writes, by the names of their objects.

    With force messages the frames get a lower priority, because a force message must not wait for
    a burst of 7 ms.
    """
    numbers = {
        "COB-ID SYNC message": od.COB_SYNC,
        "Synchronous window length": round(WINDOW_SHARE * settings.sync_period_s * 1e6),
        "Communication cycle period": round(settings.sync_period_s * 1e6),
        "Producer heartbeat time": round(settings.heartbeat_s * 1e3),
    }
    if forces:
        numbers[od.FRAMES_COB_ID] = od.COB_TPDO3 + node_id
        numbers[od.FORCES_TIMER] = round(settings.force_period_s * 1e3)
    return numbers


def set_up(
    objects: PolledSdoClient, settings: LinkSettings, node_id: int, table: bytes | None
) -> None:
    """Write the periods, and with a table start the force messages; all values are read back.

    Parameters
    ----------
    table
        Object 0x2141, see `tactile.frames.force_table`; None without force messages.
    """
    numbers = written(settings, node_id, forces=table is not None)
    for name, number in numbers.items():
        if name == od.FRAMES_COB_ID:
            # A PDO's identifier may be changed only while the PDO is off (CiA 301, 7.5.2.37).
            objects[name].raw = od.PDO_INVALID | number
        objects[name].raw = number
    checks = _checks(objects, numbers)
    if table is not None:
        objects[od.FORCE_TABLE].raw = table
        stored = objects[od.FORCE_TABLE].raw
        text = stored[-2:].hex() if stored == table else f"{len(stored)} bytes of another table"
        forces_id = {od.FORCES_COB_ID: od.COB_TPDO2 + node_id}
        messages = _checks(objects, forces_id | objects.defaults("TPDO2 mapping parameter"))
        checks += [(od.FORCE_TABLE, table[-2:].hex(), text), *messages]
    refuse_mismatch(checks, f"{objects.name} did not keep its set-up")
