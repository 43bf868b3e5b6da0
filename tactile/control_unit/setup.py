"""Setup of the control unit: checks of its identity and taxels, then its periods and its table."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from tactile.can.sdo_client import ObjectAccess
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.settings import ExpectedIdentity, LinkSettings, NodeIdentity
from tactile.errors import IdentityMismatch
from tactile.frames.codec import FrameFormat
from tactile.layout import TaxelLayout

_COB_ID_MASK = 0xFFFF_FFFF & ~(1 << 30)
"""Compared bits of a PDO's COB-ID entry: bit 30 only forbids RTR (CiA 301, 7.5.2.37)."""
_CHECK_CONFIG = (
    "Check which unit is plugged in, and the node-ID, serial number and layout in the configuration"
)
_CHECK_STORED = (
    "Write the expected ones with a CANopen tool (1019h while 1006h is 0), store them in the "
    "unit, then start again"
)


@dataclass(frozen=True, slots=True)
class Check:
    """One row of a comparison; ``expected`` None accepts anything."""

    what: str
    expected: int | str | None
    found: int | str

    @property
    def ok(self) -> bool:
        """Whether the found value is accepted."""
        return self.expected is None or self.expected == self.found


_Row = tuple[str, int, int, int]
"""Name of an unsigned object, its index and sub-index, and its expected value."""


def read_identity(objects: ObjectAccess) -> NodeIdentity:
    """Read the identity object, the device name and the boards of the pads."""
    vendor_id, product_code, revision, serial = (
        objects.read_unsigned(od.IDENTITY, sub)
        for sub in (
            od.IDENTITY_VENDOR,
            od.IDENTITY_PRODUCT,
            od.IDENTITY_REVISION,
            od.IDENTITY_SERIAL,
        )
    )
    return NodeIdentity(
        vendor_id=vendor_id,
        product_code=product_code,
        revision=revision,
        serial=serial,
        name=objects.read_text(od.DEVICE_NAME),
        boards=(objects.read_unsigned(od.BOARDS, 1), objects.read_unsigned(od.BOARDS, 2)),
    )


def identity_checks(identity: NodeIdentity, expected: ExpectedIdentity) -> list[Check]:
    """Return the comparison of the found identity with the expected one."""
    major = None if expected.revision is None else expected.revision >> 16
    return [
        Check("vendor-ID", expected.vendor_id, identity.vendor_id),
        Check("product code", expected.product_code, identity.product_code),
        Check("major revision", major, identity.revision >> 16),
        Check("serial number", expected.serial, identity.serial),
        *(
            Check(f"pads' board of finger {finger}", board, identity.boards[finger])
            for finger, board in enumerate(expected.boards or (None, None))
        ),
    ]


def refuse_other_unit(
    objects: ObjectAccess, layout: TaxelLayout, node_id: int, expected: ExpectedIdentity
) -> NodeIdentity:
    """Return the identity of the unit; IdentityMismatch if it is not the one of the config.

    SYNC is sent without a counter, so a unit with an overflow value answers by emergency 8240h.
    """
    identity, boards = read_identity(objects), expected.boards
    if boards is not None and boards[0] != boards[1] and identity.boards == boards[::-1]:
        raise IdentityMismatch(
            f"the pads of the two fingers are exchanged at {objects.name}: the board of finger 0 "
            f"is {identity.boards[0]}, expected {boards[0]}, that of finger 1 is "
            f"{identity.boards[1]}, expected {boards[1]}. Exchange their cables at the unit, or "
            "correct tactile.board_serial_numbers"
        )
    other = f"{objects.name} is not the configured unit"
    refuse_mismatch(identity_checks(identity, expected), other)
    form = FrameFormat.of(layout)
    rows = (
        ("taxels", od.LAYOUT, od.LAYOUT_TAXELS, layout.n_taxels),
        ("full scale", od.LAYOUT, od.LAYOUT_ADC_MAX, layout.adc_max),
        ("sample bytes", od.FORMAT, od.FORMAT_SAMPLE_BYTES, layout.sample_bytes),
        ("messages per frame", od.FORMAT, od.FORMAT_MESSAGES, form.n_messages),
        ("header bytes", od.FORMAT, od.FORMAT_HEADER_BYTES, form.header_bytes),
        ("TPDO1 entries", od.TPDO1_MAPPING, 0, len(od.TPDO1_ENTRIES)),
        *_mapping("TPDO1", od.TPDO1_MAPPING, od.TPDO1_ENTRIES),
    )
    found_hash = objects.read_text(od.LAYOUT, od.LAYOUT_HASH)
    checks = [Check("layout hash", layout.layout_hash, found_hash), *_read_rows(objects, rows)]
    checks.append(_cob_id_check(objects, "TPDO1", od.TPDO1_PARAMETER, od.COB_TPDO1 + node_id))
    refuse_mismatch(checks, other)
    overflow = int.from_bytes(objects.find(od.SYNC_OVERFLOW) or b"", "little")
    kind = od.PDO_OF_MANUFACTURER
    row = ("TPDO1 transmission type (1800h:02)", od.TPDO1_PARAMETER, od.PDO_TRANSMISSION, kind)
    stored = [*_read_rows(objects, [row]), Check("SYNC counter overflow (1019h)", 0, overflow)]
    refuse_mismatch(stored, f"{objects.name} has stored values that do not fit", _CHECK_STORED)
    return identity


def _read_rows(objects: ObjectAccess, rows: Iterable[_Row]) -> list[Check]:
    """Read unsigned objects, and return them with their expected values."""
    return [
        Check(what, expected, objects.read_unsigned(index, sub))
        for what, index, sub, expected in rows
    ]


def _cob_id_check(objects: ObjectAccess, name: str, parameter: int, cob_id: int) -> Check:
    found = objects.read_unsigned(parameter, od.PDO_COB_ID) & _COB_ID_MASK
    return Check(f"{name} COB-ID", cob_id, found)


def _mapping(name: str, index: int, entries: Sequence[int]) -> list[_Row]:
    return [(f"{name} entry {sub}", index, sub, one) for sub, one in enumerate(entries, start=1)]


def _shown(value: int | str | None) -> str:
    return f"{value} (0x{value:X})" if isinstance(value, int) else str(value)


def refuse_mismatch(checks: list[Check], problem: str, advice: str = _CHECK_CONFIG) -> None:
    """Raise IdentityMismatch with expected and found values if any check failed."""
    failed = [check for check in checks if not check.ok]
    if failed:
        rows = "; ".join(
            f"{check.what}: expected {_shown(check.expected)}, found {_shown(check.found)}"
            for check in failed
        )
        raise IdentityMismatch(f"{problem}: {rows}. {advice}")


def set_up(objects: ObjectAccess, settings: LinkSettings) -> None:
    """Write periods and mode, clear a zero of the unit, and read back all values.

    The samples stay raw. The host applies the zero, because a zero in the unit clips noise at zero
    counts and so biases it.
    """
    # name, index, value, bytes of the object
    writes = (
        ("SYNC COB-ID", od.SYNC_COB_ID, od.COB_SYNC, 4),
        ("SYNC window in us", od.SYNC_WINDOW_US, round(settings.window_s * 1e6), 4),
        ("SYNC period in us", od.SYNC_PERIOD_US, round(settings.sync_period_s * 1e6), 4),
        ("heartbeat in ms", od.HEARTBEAT_MS, round(settings.heartbeat_s * 1e3), 2),
    )
    checks = []
    for what, index, value, n_bytes in writes:
        objects.write_unsigned(index, 0, value, n_bytes)
        checks += _read_rows(objects, [(what, index, 0, value)])
    refuse_mismatch(checks, "the control unit did not keep its set-up")
    if objects.read_unsigned(od.TARE, od.TARE_RESULT) == od.TARE_DONE:
        objects.write_unsigned(od.TARE, od.TARE_COMMAND, od.TARE_CLEAR_SIGNATURE, 4)


def set_up_forces(objects: ObjectAccess, settings: LinkSettings, node_id: int, table: bytes) -> int:
    """Write the table of counts to force and start the force messages; all values are read back.

    The frames get a lower priority, because a force message must not wait for a burst of 7 ms.
    Returns the new COB-ID of the frames.

    Parameters
    ----------
    table
        Object 0x2141, see `tactile.frames.force_message.encode_table`.
    """
    objects.write(od.FORCE_TABLE, 0, table)
    frame_id = od.COB_TPDO3 + node_id
    frames, forces, timer = od.TPDO1_PARAMETER, od.TPDO2_PARAMETER, od.PDO_EVENT_TIMER
    # A PDO's identifier may be changed only while the PDO is off (CiA 301, 7.5.2.37).
    objects.write_unsigned(frames, od.PDO_COB_ID, od.PDO_INVALID | frame_id, 4)
    objects.write_unsigned(frames, od.PDO_COB_ID, frame_id, 4)
    period_ms = round(1e3 * settings.force_period_s)
    objects.write_unsigned(forces, timer, period_ms, 2)
    found = objects.read(od.FORCE_TABLE)
    shown = found[-2:].hex() if found == table else f"{len(found)} bytes of another table"
    rows = [("TPDO2 event timer in ms", forces, timer, period_ms)]
    checks = [
        Check("table of counts to force", table[-2:].hex(), shown),
        _cob_id_check(objects, "TPDO1", frames, frame_id),
        _cob_id_check(objects, "TPDO2", forces, od.COB_TPDO2 + node_id),
        *_read_rows(objects, rows + _mapping("TPDO2", od.TPDO2_MAPPING, od.TPDO2_ENTRIES)),
    ]
    refuse_mismatch(checks, "the control unit did not keep the set-up of its force messages")
    return frame_id
