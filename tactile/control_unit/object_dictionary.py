"""The control unit's object dictionary: its EDS, and its identifiers.

Objects have their names in `control_unit.eds`; the communication profile follows CiA 301.
"""

from functools import cache
from pathlib import Path

import canopen

EDS_PATH = Path(__file__).with_name("control_unit.eds")

COB_NMT = 0x000
COB_SYNC = 0x080
COB_EMCY = 0x080
COB_TPDO1 = 0x180
COB_TPDO2 = 0x280
COB_TPDO3 = 0x380
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

FRAMES_COB_ID = "TPDO1 communication parameter.COB-ID used by TPDO1"
FORCES_COB_ID = "TPDO2 communication parameter.COB-ID used by TPDO2"
FORCES_TIMER = "TPDO2 communication parameter.Event timer"
FORCE_MESSAGE = "Force message.Highest sub-index supported"
FORCE_TABLE = "Table of counts to force"
FORCE_ZERO = "Zero and touch threshold of the force"
"""Names in the EDS of objects that several modules use."""
PDO_INVALID = 1 << 31
"""Top bit of a PDO's COB-ID entry: the PDO is switched off."""


@cache
def of_node(node_id: int) -> canopen.ObjectDictionary:
    """Return the dictionary of the EDS for a node-ID; all links and units of a process share it.

    It is never written: canopen stores the values of a node in the node.
    """
    return canopen.import_od(str(EDS_PATH), node_id)
