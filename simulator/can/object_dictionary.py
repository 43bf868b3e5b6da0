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
_TPDO_PARAMETERS = (unit_od.TPDO1_PARAMETER, unit_od.TPDO2_PARAMETER)
_TPDO_MAPPINGS = (unit_od.TPDO1_MAPPING, unit_od.TPDO2_MAPPING)
"""Communication and mapping parameters of TPDO1 and TPDO2."""
_FIXED_VALUES = {
    (unit_od.ERROR_HISTORY, 0): 0,
    (unit_od.TPDO1_PARAMETER, unit_od.PDO_TRANSMISSION): unit_od.PDO_OF_MANUFACTURER,
    (unit_od.TPDO2_PARAMETER, unit_od.PDO_TRANSMISSION): unit_od.PDO_OF_MANUFACTURER,
}
"""The only value that the host may write to an object: 0 clears the history of errors."""


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
        missing: frozenset[int] = frozenset(),
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
        self._constants: dict[tuple[int, int], int | str | bytes] = {
            (unit_od.LAYOUT, unit_od.LAYOUT_PADS): layout.n_pads,
            (unit_od.LAYOUT, unit_od.LAYOUT_TAXELS): layout.n_taxels,
            (unit_od.LAYOUT, unit_od.LAYOUT_HASH): layout.layout_hash,
            (unit_od.LAYOUT, unit_od.LAYOUT_ADC_MAX): layout.adc_max,
            (unit_od.FORMAT, unit_od.FORMAT_SAMPLE_BITS): layout.sample_bits,
            (unit_od.FORMAT, unit_od.FORMAT_SAMPLE_BYTES): form.sample_bytes,
            (unit_od.FORMAT, unit_od.FORMAT_MESSAGES): form.n_messages,
            (unit_od.FORMAT, unit_od.FORMAT_HEADER_BYTES): form.header_bytes,
            (unit_od.PAD_SHAPES, 0): shapes,
            (unit_od.IDENTITY, unit_od.IDENTITY_SERIAL): serial_number,
        }
        self._live: dict[int, Callable[[int], int | bytes | None]] = {
            unit_od.ERROR_REGISTER: lambda _subindex: self.error_register,
            unit_od.ERROR_HISTORY: self._read_history,
            unit_od.LAST_FRAME: self._read_frame,
            unit_od.LAST_FRAME_COUNTER: lambda _subindex: scanner.read_counter,
            unit_od.BOARDS: lambda subindex: boards()[subindex - 1] if subindex else None,
        }
        node.add_read_callback(self._read)
        node.add_write_callback(self._check)
        node.add_write_callback(self._act)

    def pretend(
        self, index: int, subindex: int, value: int | str | bytes | None
    ) -> int | str | bytes | None:
        """Replace the value of a constant; returns the previous value, None: that of the EDS."""
        before = self._constants.get((index, subindex))
        if value is None:
            self._constants.pop((index, subindex), None)
        else:
            self._constants[index, subindex] = value
        return before

    def reset(self, *, everything: bool) -> None:
        """Go back to the defaults: the communication profile, or all objects."""
        for index in list(self._node.data_store):
            if everything or index in _COMMUNICATION_PROFILE:
                del self._node.data_store[index]
        self.errors.clear()
        self.error_register = 0

    def number(self, index: int, subindex: int = 0) -> int:
        """Return the value of an unsigned object."""
        return int.from_bytes(self._node.get_data(index, subindex), "little")

    @property
    def sync_cob_id(self) -> int:
        """Identifier of SYNC, object 0x1005."""
        return self.number(unit_od.SYNC_COB_ID) & _COB_ID_BITS

    def pdo_cob_id(self, pdo: int) -> int | None:
        """Return the identifier of TPDO ``pdo`` (1, 2); None while it is off."""
        value = self.number(_TPDO_PARAMETERS[pdo - 1], 1)
        return None if value & unit_od.PDO_INVALID else value & _COB_ID_BITS

    def _read(self, *, index: int, subindex: int, od: ODVariable) -> int | str | bytes | None:
        self._check_there(index, subindex, od)
        constant = self._constants.get((index, subindex))
        if constant is not None:
            return constant
        read = self._live.get(index)
        return None if read is None else read(subindex)

    def _check_there(self, index: int, subindex: int, od: ODVariable) -> None:
        if index in self._missing:
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

    def _check(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        self._check_there(index, subindex, od)
        value = int.from_bytes(data, "little")
        if od.max is not None and value > od.max:
            raise canopen.SdoAbortedError(VALUE_HIGH)
        if od.min is not None and value < od.min:
            raise canopen.SdoAbortedError(VALUE_LOW)
        cob_id = value & _FRAME_BIT_AND_COB_ID
        if index == unit_od.SYNC_COB_ID and not 1 <= cob_id <= _COB_ID_BITS:
            raise canopen.SdoAbortedError(VALUE_RANGE)
        fixed_value = _FIXED_VALUES.get((index, subindex))
        if fixed_value is not None and value != fixed_value:
            raise canopen.SdoAbortedError(VALUE_RANGE)
        if index in _TPDO_PARAMETERS and subindex == 1:
            self._check_cob_id(self.number(index, 1), value)
        if index in _TPDO_MAPPINGS and value != od.default and (subindex or value):
            raise canopen.SdoAbortedError(NOT_MAPPABLE)

    def _check_cob_id(self, present: int, value: int) -> None:
        both_on = not (present & unit_od.PDO_INVALID or value & unit_od.PDO_INVALID)
        if not _LOWEST_PDO_COB_ID <= value & _FRAME_BIT_AND_COB_ID <= _HIGHEST_PDO_COB_ID:
            raise canopen.SdoAbortedError(VALUE_RANGE)
        if both_on and (present ^ value) & _COB_ID_BITS:
            raise canopen.SdoAbortedError(VALUE_RANGE)

    def _act(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        del od
        if index == unit_od.ERROR_HISTORY:
            self.errors.clear()
        take = {
            unit_od.FORCE_TABLE: self._scanner.forces.take_table,
            unit_od.FORCE_ZERO: self._scanner.forces.take_zero,
        }.get(index)
        if take is not None:
            try:
                take(bytes(data))
            except DamagedObject as error:
                raise canopen.SdoAbortedError(VALUE_RANGE) from error
        # The simulated unit takes no zero of its own, so it can only be told to have none.
        tare = (index, subindex) == (unit_od.TARE, unit_od.TARE_COMMAND)
        if tare and int.from_bytes(data, "little") != unit_od.TARE_CLEAR_SIGNATURE:
            raise canopen.SdoAbortedError(NOT_STORED)
