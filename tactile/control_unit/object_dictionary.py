"""The control unit's object dictionary: its EDS, the names of its objects, its identifiers.

Indices and sub-indices as in `control_unit.eds`; the communication profile follows CiA 301.
"""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import canopen

EDS_PATH = Path(__file__).with_name("control_unit.eds")

COB_NMT = 0x000
COB_SYNC = 0x080
COB_EMCY = 0x080
COB_TPDO1 = 0x180
COB_TPDO2 = 0x280
COB_TPDO3 = 0x380
COB_SDO_RESPONSE = 0x580
COB_SDO_REQUEST = 0x600
COB_HEARTBEAT = 0x700
"""Identifiers of the pre-defined connection set (CiA 301, 7.3.5). Except for NMT and SYNC, add the
node-ID."""

VENDOR_ID = 0x00005443
"""Placeholder, not assigned by CiA."""
PRODUCT_CODE = 0x00000408
"""Chosen by this project: the number of taxels of the paper's sensor, as digits."""
REVISION = 0x00010001
"""Major revision 1 (behaviour on the bus) in the upper 16 bits, minor revision 1 below: a unit of
minor revision 0 has no force messages."""

DEVICE_TYPE = 0x1000
ERROR_REGISTER = 0x1001
ERROR_HISTORY = 0x1003
SYNC_COB_ID = 0x1005
SYNC_PERIOD_US = 0x1006
"""U32, period of the host's SYNC in µs."""
SYNC_WINDOW_US = 0x1007
"""U32, synchronous window in µs: a burst that does not end in it is cut short."""
DEVICE_NAME = 0x1008
EMCY_COB_ID = 0x1014
HEARTBEAT_MS = 0x1017
"""U16, period of the heartbeat in ms, 0 = none."""
IDENTITY = 0x1018
IDENTITY_VENDOR = 1
IDENTITY_PRODUCT = 2
IDENTITY_REVISION = 3
IDENTITY_SERIAL = 4
SYNC_OVERFLOW = 0x1019
TPDO1_PARAMETER = 0x1800
TPDO1_MAPPING = 0x1A00
TPDO1_ENTRIES = (0x2110_01_08, 0x2110_02_38)
"""The mapping of the frame messages: header U8, data U56."""
TPDO2_PARAMETER = 0x1801
TPDO2_MAPPING = 0x1A01
TPDO2_ENTRIES = (
    0x2140_01_08,
    0x2140_02_10,
    0x2140_03_10,
    0x2140_04_08,
    0x2140_05_08,
    0x2140_06_08,
)
"""The mapping of the force messages: head U8, two forces I16, centre 2 x I8, CRC U8."""
PDO_COB_ID = 1
PDO_TRANSMISSION = 2
PDO_EVENT_TIMER = 5
"""Sub-indices of a PDO's parameters: its COB-ID, its transmission type, and its period in ms, 0 for
none (CiA 301)."""
PDO_OF_MANUFACTURER = 254
"""Transmission type of both PDOs: an event that the manufacturer defines. It is SYNC for the frame
messages, which take several messages of one PDO, and the event timer for the force messages."""
PDO_INVALID = 1 << 31
"""Top bit of a PDO's COB-ID entry: the PDO is switched off."""

LAYOUT = 0x2100
LAYOUT_PADS = 1
LAYOUT_TAXELS = 2
LAYOUT_HASH = 3
"""Visible string, `TaxelLayout.layout_hash`."""
LAYOUT_ADC_MAX = 4
FORMAT = 0x2101
FORMAT_SAMPLE_BITS = 1
FORMAT_SAMPLE_BYTES = 2
FORMAT_MESSAGES = 3
FORMAT_HEADER_BYTES = 4
PAD_SHAPES = 0x2102
"""Domain: rows and columns of each pad, one byte each."""
BOARDS = 0x2103
"""U32 each: serial number of the pads' board of finger 0 (:01) and finger 1 (:02), 0 for none."""
THRESHOLDS = 0x2120
THRESHOLD_TOUCH = 1
"""U16, counts above which a taxel is touched and the unit's own tare is refused."""
TARE = 0x2130
TARE_COMMAND = 1
TARE_RESULT = 2
TARE_DONE = 2
"""Result of the unit's own tare: it is in use."""
TARE_CLEAR_SIGNATURE = int.from_bytes(b"zero", "little")
"""U32 for raw counts by a write to `TARE_COMMAND`."""
FORCE_MESSAGE = 0x2140
FORCE_TABLE = 0x2141
"""Domain: table of counts to force of both gripping pads, see `tactile.frames.force_message`."""
FORCE_ZERO = 0x2142
"""Domain: touch threshold and zero of each taxel of both gripping pads, see there."""
LAST_FRAME = 0x2200
"""Domain: the samples of the last complete frame, as in the frame messages."""
LAST_FRAME_COUNTER = 0x2201
"""U16: counter of the frame of the last upload of `LAST_FRAME`."""


@cache
def of_node(node_id: int) -> "canopen.ObjectDictionary":
    """Return the dictionary of the EDS for a node-ID; all links and units of a process share it.

    It is never written: canopen stores the values of a node in the node.
    """
    import canopen  # noqa: PLC0415  settings need the constants only, and canopen is slow to load

    return canopen.import_od(str(EDS_PATH), node_id)
