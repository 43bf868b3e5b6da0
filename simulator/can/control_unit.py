"""The tactile control unit as a CANopen device after CiA 301.

After each SYNC it latches one scan and sends it as one burst of TPDO1, at the rate of the wire; the
force on the gripping pads goes out as TPDO2, on its event timer.
This module adds to `simulator.can.node` SYNC, the history of errors and the synchronous window; and
for written values the limits of the EDS and the rules of CiA 301.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable
from canopen.sdo import constants as sdo

from simulator.can.faults import ControlUnitFaults
from simulator.can.link import mean_bits
from simulator.can.node import CanopenDevice, object_name
from simulator.can.scanner import DamagedObject, Scanner
from simulator.clock import ROUNDING_S
from simulator.world.world import PhysicalWorld
from tactile.control_unit import object_dictionary as unit_od
from tactile.layout import TaxelLayout

EMCY_WINDOW = 0xFF01
"""EMCY code: a burst was cut off, because it does not fit into the synchronous window (0x1007)."""
EMCY_OVERRUN = 0xFF02
"""EMCY code: a SYNC came during the previous burst and was skipped."""
REGISTER_GENERIC = 0x01
REGISTER_MANUFACTURER = 0x80
"""Bits of the error register 0x1001 (CiA 301, 7.5.2.2)."""

_OPERATIONAL = "OPERATIONAL"
_WORST_BITS = 135
"""Longest message of 8 data bytes on the wire in bits, all stuff bits included (ISO 11898-1)."""
_MAX_HISTORY = 8
"""Most error codes in object 0x1003: its sub-indices in the EDS."""
_FORCE_OBJECTS = frozenset((0x1801, 0x1A01, 0x2140, 0x2141, 0x2142))
"""Objects added in minor revision 1 of the unit."""
_COB_ID_BITS = 0x7FF
"""Bits of a COB-ID entry that are the identifier of 11 bits."""
_FRAME_BIT_AND_COB_ID = 0x3FFF_FFFF
"""A COB-ID entry without its two top bits; other bits than the lowest 11 mean a 29-bit identifier.
"""
_LOWEST_PDO_COB_ID, _HIGHEST_PDO_COB_ID = 0x181, 0x57F
"""Range of PDO identifiers in the pre-defined connection set."""
_COB_IDS = (unit_od.FRAMES_COB_ID, unit_od.FORCES_COB_ID)
_SYNC_COB_ID = "COB-ID SYNC message"
_ERRORS = "Pre-defined error field"


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlUnitSettings:
    """Settings of one control unit."""

    node_id: int = 5
    """1 to 127."""
    bitrate: int = 1_000_000
    """Bit rate of its CAN controller in bit/s."""
    serial_number: int = 1
    """Object 0x1018:04."""
    boards: tuple[int, int] = (1, 2)
    """Object 0x2103: serial numbers of the pads' boards on finger 0 and finger 1."""
    force_messages: bool = True
    """False: an older unit of minor revision 0, without force messages."""


class SimulatedControlUnit(CanopenDevice):
    """One control unit; it has no clock, the time is an argument."""

    def __init__(
        self,
        world: PhysicalWorld,
        layout: TaxelLayout,
        settings: ControlUnitSettings | None = None,
        *,
        faults: ControlUnitFaults | None = None,
        start_s: float = 0.0,
    ) -> None:
        self.settings = settings or ControlUnitSettings()
        self.faults = faults or ControlUnitFaults()
        node_id = self.settings.node_id
        super().__init__(node_id, unit_od.of_node(node_id), start_s)
        self.scanner = Scanner(world, layout, self.faults)
        self._missing = frozenset() if self.settings.force_messages else _FORCE_OBJECTS
        self.errors: list[int] = []
        """Error codes of 0x1003, the newest first."""
        self._error_register = 0
        form = self.scanner.format
        shapes = bytes(size for pad in layout.pads for size in (pad.rows, pad.columns))
        self._values |= {
            "Taxel layout.Number of pads": layout.n_pads,
            "Taxel layout.Number of taxels": layout.n_taxels,
            "Taxel layout.Layout hash": layout.layout_hash,
            "Taxel layout.Full scale of the counts": layout.adc_max,
            "Frame format.Sample bits": layout.sample_bits,
            "Frame format.Sample bytes": form.sample_bytes,
            "Frame format.Messages per frame": form.n_messages,
            "Frame format.Header bytes": form.header_bytes,
            "Rows and columns of each pad": shapes,
            "Identity object.Serial number": self.settings.serial_number,
            "Error register": lambda _subindex: self._error_register,
            _ERRORS: self._read_history,
            "Serial numbers of the boards": self._read_board,
        }
        self.power_cycle()

    # -- objects -------------------------------------------------------------------------------

    def pretend(self, name: str, value: int | str | bytes | None) -> int | str | bytes | None:
        """Replace the value of a constant by its name in the EDS; returns the previous one.

        None is the value of the EDS.
        """
        before: int | str | bytes | None = self._values.pop(name, None)
        if value is not None:
            self._values[name] = value
        return before

    def _check_there(self, od: ODVariable, subindex: int) -> None:
        if od.index in self._missing:
            raise canopen.SdoAbortedError(sdo.ABORT_NOT_IN_OD)
        super()._check_there(od, subindex)

    def _read_history(self, subindex: int) -> int:
        if subindex > len(self.errors):
            raise canopen.SdoAbortedError(sdo.ABORT_NO_DATA_AVAILABLE)
        return self.errors[subindex - 1] if subindex else len(self.errors)

    def _read_board(self, subindex: int) -> int | None:
        if not subindex:
            return None
        finger = subindex - 1
        return self.settings.boards[1 - finger if self.faults.pads_swapped else finger]

    def _written(self, od: ODVariable, value: Any) -> None:
        name, group = od.qualname, object_name(od)
        if od.max is not None and value > od.max:
            raise canopen.SdoAbortedError(sdo.ABORT_VALUE_TOO_HIGH)
        # Nobody changes a transmission type, and a 0 clears the history of errors.
        fixed = od.name.startswith("Transmission type") or group == _ERRORS
        if fixed and value != od.default:
            raise canopen.SdoAbortedError(sdo.ABORT_INVALID_VALUE)
        if name == _SYNC_COB_ID and not 1 <= value & _FRAME_BIT_AND_COB_ID <= _COB_ID_BITS:
            raise canopen.SdoAbortedError(sdo.ABORT_INVALID_VALUE)
        if name in _COB_IDS:
            present, cob_id = self.number(name), value & _FRAME_BIT_AND_COB_ID
            both_on = not (present | value) & unit_od.PDO_INVALID
            if not _LOWEST_PDO_COB_ID <= cob_id <= _HIGHEST_PDO_COB_ID or (
                both_on and (present ^ value) & _COB_ID_BITS
            ):
                raise canopen.SdoAbortedError(sdo.ABORT_INVALID_VALUE)
        if group == _ERRORS:
            self.errors.clear()
        try:
            if name == unit_od.FORCE_TABLE:
                self.scanner.forces.take_table(bytes(value))
            elif name == unit_od.FORCE_ZERO:
                self.scanner.forces.take_zero(bytes(value))
        except DamagedObject as error:
            raise canopen.SdoAbortedError(sdo.ABORT_INVALID_VALUE) from error

    # -- device on the bus ---------------------------------------------------------------------

    def next_event_s(self) -> float:
        """Return the time in s of the unit's next own message; infinity: never."""
        return min(super().next_event_s(), self._force_due_s)

    def advance(self, now_s: float) -> None:
        """Let the time pass until ``now_s`` s: boot-up, heartbeat, force messages."""
        super().advance(now_s)
        while self._force_due_s <= now_s:
            self._send_force(self._force_due_s)
            self._force_due_s += self._force_period_s * self.faults.forces_each

    def _take(self, can_id: int, _data: bytes) -> None:
        if can_id == self._sync_id:
            self._sync()

    def emergency(self, code: int, *, register: int = REGISTER_GENERIC) -> None:
        """Report an error: EMCY, error register and history; code 0: all errors are cleared.

        Parameters
        ----------
        code
            Error code after CiA 301, 16 bit.
        register
            Bits of the error register that it sets.
        """
        if code == 0:
            self._error_register = 0
        else:
            self._error_register |= register | REGISTER_GENERIC
            self.errors.insert(0, code)
            del self.errors[_MAX_HISTORY:]
        if not math.isfinite(self._boot_due_s) and self.nmt_state != "STOPPED":
            self._node.emcy.send(code, self._error_register)

    def _reset(self, *, everything: bool) -> None:
        super()._reset(everything=everything)
        self.errors.clear()
        self._error_register = 0
        if everything:
            self.scanner.reset()
        self._take_settings()
        self._burst_end_s = self._force_end_s = -math.inf
        self._force_due_s, self._force_period_s = math.inf, 0.0
        self._forces_lost = 0.0
        self._forces_later: deque[tuple[float, bytes]] = deque()

    def _pdo_cob_id(self, name: str) -> int | None:
        """Return the identifier of a TPDO; None while it is off."""
        value = self.number(name)
        return None if value & unit_od.PDO_INVALID else value & _COB_ID_BITS

    def _take_settings(self) -> None:
        """Apply the values of the dictionary, after each SDO request and change of state."""
        self._sync_id = self.number(_SYNC_COB_ID) & _COB_ID_BITS
        self._window_s = 1e-6 * self.number("Synchronous window length")
        self._frame_id = self._pdo_cob_id(unit_od.FRAMES_COB_ID)
        forces = self.settings.force_messages
        self._force_id = self._pdo_cob_id(unit_od.FORCES_COB_ID) if forces else None

    def _changed(self) -> None:
        """Take over the settings; start, continue or stop the event timer of the force messages."""
        self._take_settings()
        period_s = 0.0
        if self.settings.force_messages and self.nmt_state == _OPERATIONAL:
            period_s = 1e-3 * self.number(unit_od.FORCES_TIMER)
        if period_s != self._force_period_s:
            self._force_period_s = period_s
            self._force_due_s = self._network.now_s + period_s if period_s else math.inf

    def _send_force(self, due_s: float) -> None:
        """Scan the gripping pads and send their force, unless the last message still waits."""
        can_id = self._force_id
        if can_id is None or self.faults.dead or self.faults.forces_off:
            return
        if due_s < self._force_end_s - ROUNDING_S:
            self.scanner.force_overrun = True
            return
        messages = [self.scanner.force_message(self._force_period_s)]
        self._forces_lost += self.faults.forces_lost
        if self._forces_lost >= 1.0:
            self._forces_lost -= 1.0
            messages.clear()
        if later_s := self.faults.forces_late_s:
            self._forces_later.extend((due_s + later_s, message) for message in messages)
            messages.clear()
        while self._forces_later and self._forces_later[0][0] <= due_s + ROUNDING_S:
            messages.append(self._forces_later.popleft()[1])
        if messages:
            self._force_end_s = self.send(due_s, can_id, messages)

    def _sync(self) -> None:
        if self.nmt_state != _OPERATIONAL:
            return
        now_s = self._network.now_s
        if now_s < self._burst_end_s - ROUNDING_S:
            self._passed_over(EMCY_OVERRUN)
            return
        messages = self.scanner.frame_messages()
        window_s, bit_s = self._window_s, 1.0 / self.settings.bitrate
        if window_s and len(messages) * _WORST_BITS * bit_s > window_s:
            used_s, fitting = 0.0, 0
            for message in messages:
                used_s += mean_bits(message) * bit_s
                if used_s > window_s:
                    break
                fitting += 1
            if fitting < len(messages):
                messages = messages[:fitting]
                self._passed_over(EMCY_WINDOW)
        if self._frame_id is not None and messages:
            self._burst_end_s = self.send(now_s, self._frame_id, messages)

    def _passed_over(self, code: int) -> None:
        """Mark the next frame, and send one EMCY for a repeated error."""
        self.scanner.overrun = True
        if code not in self.errors:
            self.emergency(code, register=REGISTER_MANUFACTURER)

    def _heartbeat_silenced(self) -> bool:
        return self.faults.dead or self.faults.heartbeat_off

    def _silenced(self) -> bool:
        return self.faults.dead
