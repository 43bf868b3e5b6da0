"""The control unit's object dictionary: its EDS, filled and guarded.

canopen's LocalNode keeps the values and serves them by SDO. What it leaves open is done here:
values that live elsewhere in the unit, limits from the EDS, sub-indices of plain variables, and
the rules of CiA 301 on which object may be written when.
"""

from collections.abc import Callable, Mapping
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable

from simulator.unit_scan import Scanner
from tactile import eds
from tactile.layout import TaxelLayout

NO_SUBINDEX = 0x0609_0011
NOT_MAPPABLE = 0x0604_0041
VALUE_RANGE = 0x0609_0030
VALUE_HIGH = 0x0609_0031
VALUE_LOW = 0x0609_0032
NOT_STORED = 0x0800_0020
WRONG_STATE = 0x0800_0022
NO_DATA = 0x0800_0024

_PDO_INVALID = 1 << 31
_EDS_FULL_SCALE = 255
_TPDO_PARAMETERS = (0x1800, 0x1801, 0x1802)
_TPDO_MAPPINGS = (0x1A00, 0x1A01, 0x1A02)


class UnitDictionary:
    """Object dictionary of one unit.

    Parameters
    ----------
    node
        The canopen LocalNode, made from the unit's EDS; this class adds its callbacks to it.
    layout
        The taxels, for the objects that describe them.
    scanner
        Where tare and last frame live.
    serial_number
        Object 0x1018:04.
    identity
        Other sub-indices of 0x1018 that differ from the EDS.
    boards
        Returns object 0x2103: the serial numbers of the pads' boards as they are plugged in.

    Attributes
    ----------
    errors
        Error codes of 0x1003, the newest first.
    error_register
        Object 0x1001.
    """

    __slots__ = ("_constants", "_live", "_node", "_scanner", "error_register", "errors")

    def __init__(
        self,
        node: Any,
        layout: TaxelLayout,
        scanner: Scanner,
        *,
        serial_number: int,
        identity: Mapping[int, int] | None = None,
        boards: Callable[[], tuple[int, int]] = lambda: (0, 0),
    ) -> None:
        self._node: Any = node
        self._scanner = scanner
        self.errors: list[int] = []
        self.error_register = 0
        form = scanner.frame_format
        scale = layout.adc_max / _EDS_FULL_SCALE
        shapes = bytes(size for pad in layout.pads for size in (pad.rows, pad.columns))
        self._constants: dict[tuple[int, int], int | str | bytes] = {
            (eds.LAYOUT, eds.LAYOUT_PADS): layout.n_pads,
            (eds.LAYOUT, eds.LAYOUT_TAXELS): layout.n_taxels,
            (eds.LAYOUT, eds.LAYOUT_HASH): layout.layout_hash,
            (eds.LAYOUT, eds.LAYOUT_ADC_MAX): layout.adc_max,
            (eds.FORMAT, eds.FORMAT_SAMPLE_BITS): layout.sample_bits,
            (eds.FORMAT, eds.FORMAT_SAMPLE_BYTES): form.sample_bytes,
            (eds.FORMAT, eds.FORMAT_MESSAGES): form.n_messages,
            (eds.FORMAT, eds.FORMAT_HEADER_BYTES): form.header_bytes,
            (eds.PAD_SHAPES, 0): shapes,
            (eds.IDENTITY, eds.IDENTITY_SERIAL): serial_number,
        }
        for subindex, value in (identity or {}).items():
            self._constants[(eds.IDENTITY, subindex)] = value
        self._live: dict[int, Callable[[int], int | bytes | None]] = {
            eds.ERROR_REGISTER: lambda _subindex: self.error_register,
            eds.ERROR_HISTORY: self._read_history,
            eds.LAST_FRAME: self._read_frame,
            eds.LAST_FRAME_COUNTER: lambda _subindex: scanner.read_counter,
            eds.TARE: self._read_tare,
            eds.BOARDS: lambda subindex: boards()[subindex - 1] if subindex else None,
        }
        # The EDS gives thresholds for 8 bit; a unit with a finer converter scales them.
        self._defaults(scale)
        node.add_read_callback(self._read)
        node.add_write_callback(self._check)
        node.add_write_callback(self._act)

    def pretend(
        self, index: int, subindex: int, value: int | str | bytes | None
    ) -> int | str | bytes | None:
        """Let a constant read as another value; returns what it was, None for the EDS's own."""
        before = self._constants.get((index, subindex))
        if value is None:
            self._constants.pop((index, subindex), None)
        else:
            self._constants[index, subindex] = value
        return before

    def reset(self, layout: TaxelLayout, *, everything: bool) -> None:
        """Go back to the defaults: the communication profile, or all objects."""
        for index in list(self._node.data_store):
            if everything or 0x1000 <= index < 0x2000:
                del self._node.data_store[index]
        if everything:
            self._defaults(layout.adc_max / _EDS_FULL_SCALE)
        self.errors.clear()
        self.error_register = 0

    def number(self, index: int, subindex: int = 0) -> int:
        """Return the value of an unsigned object."""
        return int.from_bytes(self._node.get_data(index, subindex), "little")

    def pdo_cob_id(self, pdo: int) -> int | None:
        """Return the identifier of TPDO ``pdo`` (1 to 3), None while it is switched off."""
        value = self.number(_TPDO_PARAMETERS[pdo - 1], 1)
        return None if value & _PDO_INVALID else value & 0x7FF

    def _defaults(self, scale: float) -> None:
        if scale == 1.0:
            return
        for subindex in (eds.THRESHOLD_TOUCH, eds.THRESHOLD_TARE_SPREAD):
            default = self._node.object_dictionary[eds.THRESHOLDS][subindex].default
            data = round(default * scale).to_bytes(2, "little")
            self._node.data_store.setdefault(eds.THRESHOLDS, {})[subindex] = data

    def _read(self, *, index: int, subindex: int, od: ODVariable) -> int | str | bytes | None:
        if subindex != od.subindex:
            raise canopen.SdoAbortedError(NO_SUBINDEX)
        constant = self._constants.get((index, subindex))
        if constant is not None:
            return constant
        read = self._live.get(index)
        return None if read is None else read(subindex)

    def _read_history(self, subindex: int) -> int:
        if subindex > len(self.errors):
            raise canopen.SdoAbortedError(NO_DATA)
        return self.errors[subindex - 1] if subindex else len(self.errors)

    def _read_frame(self, _subindex: int) -> bytes:
        frame = self._scanner.last_frame()
        if frame is None:
            raise canopen.SdoAbortedError(NO_DATA)
        return frame

    def _read_tare(self, subindex: int) -> int | None:
        if subindex == eds.TARE_RESULT:
            return int(self._scanner.tare_result)
        return self._scanner.tare_largest if subindex == eds.TARE_LARGEST else None

    def _check(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        if subindex != od.subindex:
            raise canopen.SdoAbortedError(NO_SUBINDEX)
        value = int.from_bytes(data, "little")
        if od.max is not None and value > od.max:
            raise canopen.SdoAbortedError(VALUE_HIGH)
        if od.min is not None and value < od.min:
            raise canopen.SdoAbortedError(VALUE_LOW)
        if index == eds.SYNC_COB_ID and not 1 <= value & 0x3FFF_FFFF <= 0x7FF:
            raise canopen.SdoAbortedError(VALUE_RANGE)
        if index == eds.SYNC_OVERFLOW:
            if value == 1:
                raise canopen.SdoAbortedError(VALUE_RANGE)
            if self.number(eds.SYNC_PERIOD_US):
                raise canopen.SdoAbortedError(WRONG_STATE)
        if index in _TPDO_PARAMETERS and subindex == 1:
            self._check_cob_id(self.number(index, 1), value)
        if index in _TPDO_MAPPINGS:
            self._check_mapping(_TPDO_MAPPINGS.index(index), subindex, value)

    def _check_cob_id(self, present: int, value: int) -> None:
        both_on = not (present & _PDO_INVALID or value & _PDO_INVALID)
        if not 0x181 <= value & 0x3FFF_FFFF <= 0x57F:
            raise canopen.SdoAbortedError(VALUE_RANGE)
        if both_on and (present ^ value) & 0x7FF:
            raise canopen.SdoAbortedError(VALUE_RANGE)

    def _check_mapping(self, pdo: int, subindex: int, value: int) -> None:
        """Let the fixed mapping be written again, in the order of CiA 301, but not changed."""
        mapping: Any = self._node.object_dictionary[_TPDO_MAPPINGS[pdo]]
        if not self.number(_TPDO_PARAMETERS[pdo], 1) & _PDO_INVALID:
            raise canopen.SdoAbortedError(WRONG_STATE)
        if subindex == 0 and value not in {0, mapping[0].default}:
            raise canopen.SdoAbortedError(NOT_MAPPABLE)
        if subindex and value != mapping[subindex].default:
            raise canopen.SdoAbortedError(NOT_MAPPABLE)

    def _act(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        del od
        if (index, subindex) != (eds.TARE, eds.TARE_COMMAND):
            return
        command = int.from_bytes(data, "little")
        if command == eds.TARE_SIGNATURE:
            self._scanner.start_tare(
                self.number(eds.TARE, eds.TARE_FRAMES),
                self.number(eds.THRESHOLDS, eds.THRESHOLD_TOUCH),
                self.number(eds.THRESHOLDS, eds.THRESHOLD_TARE_SPREAD),
            )
        elif command == eds.TARE_CLEAR_SIGNATURE:
            self._scanner.clear_tare()
        else:
            raise canopen.SdoAbortedError(NOT_STORED)
