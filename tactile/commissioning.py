"""Checks that the unit is the expected one with the expected taxels, and sets it up."""

from dataclasses import dataclass

from tactile import eds
from tactile.errors import IdentityMismatch
from tactile.layout import TaxelLayout
from tactile.link_settings import ExpectedIdentity, LinkSettings, NodeIdentity
from tactile.protocol import FrameFormat
from tactile.sdo import ObjectAccess

_COB_ID_MASK = 0x1FFFFFFF | 1 << 31
"""Identifier and valid bit of a PDO's COB-ID entry; the bit between them only forbids RTR."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One row of the comparison; ``expected`` None accepts anything."""

    what: str
    expected: int | str | None
    found: int | str

    @property
    def ok(self) -> bool:
        """Whether what was found is accepted."""
        return self.expected is None or self.expected == self.found


def read_identity(objects: ObjectAccess) -> NodeIdentity:
    """Read the identity object and the device name."""
    return NodeIdentity(
        vendor_id=objects.read_unsigned(eds.IDENTITY, eds.IDENTITY_VENDOR),
        product_code=objects.read_unsigned(eds.IDENTITY, eds.IDENTITY_PRODUCT),
        revision=objects.read_unsigned(eds.IDENTITY, eds.IDENTITY_REVISION),
        serial=objects.read_unsigned(eds.IDENTITY, eds.IDENTITY_SERIAL),
        name=objects.read_text(eds.DEVICE_NAME),
        boards=(objects.read_unsigned(eds.BOARDS, 1), objects.read_unsigned(eds.BOARDS, 2)),
    )


def identity_checks(identity: NodeIdentity, expected: ExpectedIdentity) -> list[Check]:
    """Compare the identity."""
    major = None if expected.revision is None else expected.revision >> 16
    return [
        Check(what="vendor-ID", expected=expected.vendor_id, found=identity.vendor_id),
        Check(what="product code", expected=expected.product_code, found=identity.product_code),
        Check(what="major revision", expected=major, found=identity.revision >> 16),
        Check(what="serial number", expected=expected.serial, found=identity.serial),
        *(
            Check(
                what=f"pads' board of finger {finger}",
                expected=None if expected.boards is None else expected.boards[finger],
                found=identity.boards[finger],
            )
            for finger in (0, 1)
        ),
    ]


def refuse_swapped_boards(identity: NodeIdentity, expected: ExpectedIdentity, name: str) -> None:
    """Raise IdentityMismatch if each finger has the pads of the other one."""
    boards = expected.boards
    if boards is not None and boards[0] != boards[1] and identity.boards == boards[::-1]:
        raise IdentityMismatch(
            f"the pads of the two fingers are exchanged at {name}: the board of finger 0 is "
            f"{identity.boards[0]}, expected {boards[0]}, that of finger 1 is "
            f"{identity.boards[1]}, expected {boards[1]}. Exchange their cables at the unit, or "
            "correct tactile.board_serial_numbers"
        )


def layout_checks(objects: ObjectAccess, layout: TaxelLayout, node_id: int) -> list[Check]:
    """Compare the taxels, the frame format and the mapping of the frame messages."""
    frame_format = FrameFormat.of(layout)
    unsigned = (
        ("taxels", eds.LAYOUT, eds.LAYOUT_TAXELS, layout.n_taxels),
        ("full scale", eds.LAYOUT, eds.LAYOUT_ADC_MAX, layout.adc_max),
        ("sample bytes", eds.FORMAT, eds.FORMAT_SAMPLE_BYTES, layout.sample_bytes),
        ("messages per frame", eds.FORMAT, eds.FORMAT_MESSAGES, frame_format.n_messages),
        ("header bytes", eds.FORMAT, eds.FORMAT_HEADER_BYTES, frame_format.header_bytes),
        ("TPDO1 entries", eds.TPDO1_MAPPING, 0, len(eds.TPDO1_ENTRIES)),
        *(
            (f"TPDO1 entry {sub}", eds.TPDO1_MAPPING, sub, entry)
            for sub, entry in enumerate(eds.TPDO1_ENTRIES, start=1)
        ),
    )
    checks = [
        Check(
            what="layout hash",
            expected=layout.layout_hash,
            found=objects.read_text(eds.LAYOUT, eds.LAYOUT_HASH),
        )
    ]
    checks += [
        Check(what=what, expected=expected, found=objects.read_unsigned(index, sub))
        for what, index, sub, expected in unsigned
    ]
    checks.append(
        Check(
            what="TPDO1 COB-ID",
            expected=0x180 + node_id,
            found=objects.read_unsigned(eds.TPDO1_PARAMETER, 1) & _COB_ID_MASK,
        )
    )
    return checks


def _shown(value: int | str | None) -> str:
    return f"{value} (0x{value:X})" if isinstance(value, int) else str(value)


def refuse_mismatch(checks: list[Check], name: str) -> None:
    """Raise IdentityMismatch with expected and found values if any check failed."""
    failed = [check for check in checks if not check.ok]
    if failed:
        rows = "; ".join(
            f"{check.what}: expected {_shown(check.expected)}, found {_shown(check.found)}"
            for check in failed
        )
        raise IdentityMismatch(
            f"{name} is not the configured unit: {rows}. Check which unit is plugged in, and the "
            "node-ID, serial number and layout in the configuration"
        )


def set_up(objects: ObjectAccess, settings: LinkSettings) -> None:
    """Write periods and mode, drop a zero that the unit may hold, and read all of it back.

    The samples stay raw: the zero is the host's, because a unit's own one clips noise at zero
    counts and so biases it.
    """
    writes = (
        ("SYNC COB-ID", eds.SYNC_COB_ID, 0x80, 4),
        ("SYNC window in us", eds.SYNC_WINDOW_US, round(settings.window_s * 1e6), 4),
        ("SYNC period in us", eds.SYNC_PERIOD_US, round(settings.sync_period_s * 1e6), 4),
        ("heartbeat in ms", eds.HEARTBEAT_MS, round(settings.heartbeat_s * 1e3), 2),
        ("mode", eds.MODE, int(settings.mode), 1),
    )
    checks = []
    for what, index, value, n_bytes in writes:
        objects.write_unsigned(index, 0, value, n_bytes)
        checks.append(Check(what=what, expected=value, found=objects.read_unsigned(index)))
    refuse_mismatch(checks, "the control unit did not keep its set-up and so")
    if objects.read_unsigned(eds.TARE, eds.TARE_RESULT) == eds.TareResult.DONE:
        objects.write_unsigned(eds.TARE, eds.TARE_COMMAND, eds.TARE_CLEAR_SIGNATURE, 4)
