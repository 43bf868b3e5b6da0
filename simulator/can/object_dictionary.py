"""The control unit's object dictionary: its EDS, filled.

canopen's LocalNode keeps the values and serves them by SDO. This module adds values from other
parts of the unit, limits from the EDS, sub-indices of plain variables, and the rules of CiA 301 for
writes.
"""

from collections.abc import Callable
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable

from simulator.can.messages import DamagedObject
from simulator.can.scanner import Scanner
from tactile.control_unit import object_dictionary as unit_od
from tactile.layout import TaxelLayout

NO_OBJECT = 0x0602_0000
NOT_MAPPABLE = 0x0604_0041
NO_SUBINDEX = 0x0609_0011
VALUE_RANGE = 0x0609_0030
VALUE_HIGH = 0x0609_0031
VALUE_LOW = 0x0609_0032
NOT_STORED = 0x0800_0020
WRONG_STATE = 0x0800_0022
NO_DATA = 0x0800_0024
"""SDO abort codes (CiA 301, 7.2.4.3.17)."""

_COB_ID_BITS = 0x7FF
"""Bits of a COB-ID entry that are the identifier of 11 bits."""
_FRAME_BIT_AND_COB_ID = 0x3FFF_FFFF
"""A COB-ID entry without its two top bits; other bits than the lowest 11 mean a 29-bit identifier.
"""
_LOWEST_PDO_COB_ID, _HIGHEST_PDO_COB_ID = 0x181, 0x57F
"""Range of PDO identifiers in the pre-defined connection set."""
_COMMUNICATION_PROFILE = range(0x1000, 0x2000)
"""Objects that a reset of the communication sets to their defaults (CiA 301)."""
_COB_IDS = (unit_od.FRAMES_COB_ID, unit_od.FORCES_COB_ID)
_SYNC_COB_ID = "COB-ID SYNC message"
_ERRORS = "Pre-defined error field"
_FIXED_VALUES = {f"{_ERRORS}.Number of errors": 0}
"""The only value that the host may write to an object, besides the transmission type of a PDO: 0
clears the history of errors."""


class UnitDictionary:
    """Object dictionary of one unit: constants, live values, and the checks of written values.

    Parameters
    ----------
    node
        The canopen LocalNode, made from the unit's EDS; this class adds its callbacks to it.
    serial_number
        Object 0x1018:04.
    boards
        Returns object 0x2103: the serial numbers of the pads' present boards.
    missing
        Objects of the EDS that are missing in an older unit.
    """

    def __init__(
        self,
        node: Any,
        layout: TaxelLayout,
        scanner: Scanner,
        *,
        serial_number: int,
        boards: Callable[[], tuple[int, int]] = lambda: (0, 0),
        missing: frozenset[str] = frozenset(),
    ) -> None:
        self._node: Any = node
        self._scanner = scanner
        self._missing = missing
        self.errors: list[int] = []
        """Error codes of 0x1003, the newest first."""
        self.error_register = 0
        """Object 0x1001."""
        form = scanner.format
        shapes = bytes(size for pad in layout.pads for size in (pad.rows, pad.columns))
        self._values: dict[str, Any] = {
            "Taxel layout.Number of pads": layout.n_pads,
            "Taxel layout.Number of taxels": layout.n_taxels,
            "Taxel layout.Layout hash": layout.layout_hash,
            "Taxel layout.Full scale of the counts": layout.adc_max,
            "Frame format.Sample bits": layout.sample_bits,
            "Frame format.Sample bytes": form.sample_bytes,
            "Frame format.Messages per frame": form.n_messages,
            "Frame format.Header bytes": form.header_bytes,
            "Rows and columns of each pad": shapes,
            "Identity object.Serial number": serial_number,
            "Error register": lambda _subindex: self.error_register,
            _ERRORS: self._read_history,
            "Last frame": self._read_frame,
            "Counter of the last frame read": lambda _subindex: scanner.read_counter,
            "Serial numbers of the boards": lambda sub: boards()[sub - 1] if sub else None,
        }
        node.add_read_callback(self._read)
        node.add_write_callback(self._write)

    def pretend(self, name: str, value: int | str | bytes | None) -> int | str | bytes | None:
        """Replace the value of a constant by its name in the EDS; returns the previous one.

        None is the value of the EDS.
        """
        before: int | str | bytes | None = self._values.pop(name, None)
        if value is not None:
            self._values[name] = value
        return before

    def reset(self, *, everything: bool) -> None:
        """Go back to the defaults: the communication profile, or all objects."""
        for index in list(self._node.data_store):
            if everything or index in _COMMUNICATION_PROFILE:
                del self._node.data_store[index]
        self.errors.clear()
        self.error_register = 0

    def number(self, name: str) -> int:
        """Return the value of an unsigned object."""
        variable = self._node.object_dictionary[name]
        return int.from_bytes(self._node.get_data(variable.index, variable.subindex), "little")

    @property
    def sync_cob_id(self) -> int:
        """Identifier of SYNC, object 0x1005."""
        return self.number(_SYNC_COB_ID) & _COB_ID_BITS

    def pdo_cob_id(self, pdo: int) -> int | None:
        """Return the identifier of TPDO ``pdo`` (1, 2); None while it is off."""
        value = self.number(_COB_IDS[pdo - 1])
        return None if value & unit_od.PDO_INVALID else value & _COB_ID_BITS

    def _read(self, *, index: int, subindex: int, od: ODVariable) -> Any:
        del index
        self._check_there(subindex, od)
        value = self._values.get(od.qualname, self._values.get(_object_name(od)))
        return value(subindex) if callable(value) else value

    def _check_there(self, subindex: int, od: ODVariable) -> None:
        if _object_name(od) in self._missing:
            raise canopen.SdoAbortedError(NO_OBJECT)
        if subindex != od.subindex:
            raise canopen.SdoAbortedError(NO_SUBINDEX)

    def _read_history(self, subindex: int) -> int:
        if subindex > len(self.errors):
            raise canopen.SdoAbortedError(NO_DATA)
        return self.errors[subindex - 1] if subindex else len(self.errors)

    def _read_frame(self, _subindex: int) -> bytes:
        frame = self._scanner.last_frame()
        if frame is None:
            raise canopen.SdoAbortedError(NO_DATA)
        return frame

    def _write(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        """Check a write and carry out its effects."""
        del index
        self._check_there(subindex, od)
        value, name = int.from_bytes(data, "little"), od.qualname
        if od.max is not None and value > od.max:
            raise canopen.SdoAbortedError(VALUE_HIGH)
        if od.min is not None and value < od.min:
            raise canopen.SdoAbortedError(VALUE_LOW)
        cob_id = value & _FRAME_BIT_AND_COB_ID
        fixed = od.default if od.name.startswith("Transmission type") else _FIXED_VALUES.get(name)
        if (name == _SYNC_COB_ID and not 1 <= cob_id <= _COB_ID_BITS) or (
            fixed is not None and value != fixed
        ):
            raise canopen.SdoAbortedError(VALUE_RANGE)
        if name in _COB_IDS:
            present = self.number(name)
            both_on = not (present | value) & unit_od.PDO_INVALID
            if not _LOWEST_PDO_COB_ID <= cob_id <= _HIGHEST_PDO_COB_ID or (
                both_on and (present ^ value) & _COB_ID_BITS
            ):
                raise canopen.SdoAbortedError(VALUE_RANGE)
        mapping = _object_name(od).endswith("mapping parameter")
        if mapping and value != od.default and (subindex or value):
            raise canopen.SdoAbortedError(NOT_MAPPABLE)
        if _object_name(od) == _ERRORS:
            self.errors.clear()
        try:
            if name == unit_od.FORCE_TABLE:
                self._scanner.forces.take_table(bytes(data))
            elif name == unit_od.FORCE_ZERO:
                self._scanner.forces.take_zero(bytes(data))
        except DamagedObject as error:
            raise canopen.SdoAbortedError(VALUE_RANGE) from error
        # The simulated unit takes no zero of its own, so it can only be told to have none.
        if name == "Tare.Command" and value != unit_od.TARE_CLEAR_SIGNATURE:
            raise canopen.SdoAbortedError(NOT_STORED)


def _object_name(od: ODVariable) -> str:
    """Return the name of a variable's object in the EDS, without that of the sub-index."""
    name: str = od.qualname.partition(".")[0]
    return name
