"""The tactile control unit as a CANopen device after CiA 301.

After each SYNC it latches one scan and sends it as one burst of TPDO1, at the rate of the wire; the
force on the gripping pads goes out as TPDO2, on its event timer.
This module adds to `simulator.can.node` services by NMT state, resets, SYNC, the history of errors
and the synchronous window; and to the values that canopen's LocalNode keeps those of other parts of
the unit, limits from the EDS, sub-indices of plain variables, and the rules of CiA 301 for writes.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import canopen
from canopen.nmt import NMT_COMMANDS
from canopen.objectdictionary import ODVariable

from simulator.can.faults import ControlUnitFaults
from simulator.can.messages import DamagedObject
from simulator.can.node import BOOT_S, RESETS, Abort, CanopenDevice
from simulator.can.scanner import ScannedWorld, Scanner
from simulator.can.wire import mean_bits
from simulator.clock import ROUNDING_S
from tactile.control_unit import object_dictionary as unit_od
from tactile.layout import TaxelLayout

EMCY_WINDOW = 0xFF01
"""EMCY code: a burst was cut off, because it does not fit into the synchronous window (0x1007)."""
EMCY_OVERRUN = 0xFF02
"""EMCY code: a SYNC came during the previous burst and was skipped."""
REGISTER_GENERIC = 0x01
REGISTER_MANUFACTURER = 0x80
"""Bits of the error register 0x1001 (CiA 301, 7.5.2.2)."""

_OPERATIONAL, _STOPPED = "OPERATIONAL", "STOPPED"
_CHANGES_OF_STATE = tuple(
    NMT_COMMANDS[state] for state in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL")
)
"""NMT commands that the node of canopen carries out."""
_WORST_BITS = 135
"""Longest message of 8 data bytes on the wire in bits, all stuff bits included (ISO 11898-1)."""
_MAX_HISTORY = 8
"""Most error codes in object 0x1003: its sub-indices in the EDS."""
_FORCE_OBJECTS = frozenset(
    (
        "Force message",
        unit_od.FORCE_TABLE,
        unit_od.FORCE_ZERO,
        "TPDO2 communication parameter",
        "TPDO2 mapping parameter",
    )
)
"""Objects added in minor revision 1 of the unit."""
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


class UnitDictionary:
    """Object dictionary of one unit: constants, live values, and the checks of written values.

    Parameters
    ----------
    node
        The canopen LocalNode, made from the unit's EDS; this class adds its callbacks to it.
    """

    def __init__(
        self,
        node: Any,
        layout: TaxelLayout,
        scanner: Scanner,
        settings: ControlUnitSettings,
        faults: ControlUnitFaults,
    ) -> None:
        self._node: Any = node
        self._scanner = scanner
        self._boards, self._faults = settings.boards, faults
        self._missing = frozenset() if settings.force_messages else _FORCE_OBJECTS
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
            "Identity object.Serial number": settings.serial_number,
            "Error register": lambda _subindex: self.error_register,
            _ERRORS: self._read_history,
            "Last frame": self._read_frame,
            "Counter of the last frame read": lambda _subindex: scanner.read_counter,
            "Serial numbers of the boards": self._read_board,
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
            raise canopen.SdoAbortedError(Abort.NO_OBJECT)
        if subindex != od.subindex:
            raise canopen.SdoAbortedError(Abort.NO_SUBINDEX)

    def _read_history(self, subindex: int) -> int:
        if subindex > len(self.errors):
            raise canopen.SdoAbortedError(Abort.NO_DATA)
        return self.errors[subindex - 1] if subindex else len(self.errors)

    def _read_board(self, subindex: int) -> int | None:
        finger = subindex - 1
        return (
            self._boards[1 - finger if self._faults.pads_swapped else finger] if subindex else None
        )

    def _read_frame(self, _subindex: int) -> bytes:
        frame = self._scanner.last_frame()
        if frame is None:
            raise canopen.SdoAbortedError(Abort.NO_DATA)
        return frame

    def _write(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        """Check a write and carry out its effects."""
        del index
        self._check_there(subindex, od)
        value, name = int.from_bytes(data, "little"), od.qualname
        if od.max is not None and value > od.max:
            raise canopen.SdoAbortedError(Abort.VALUE_HIGH)
        if od.min is not None and value < od.min:
            raise canopen.SdoAbortedError(Abort.VALUE_LOW)
        cob_id = value & _FRAME_BIT_AND_COB_ID
        fixed = od.default if od.name.startswith("Transmission type") else _FIXED_VALUES.get(name)
        if (name == _SYNC_COB_ID and not 1 <= cob_id <= _COB_ID_BITS) or (
            fixed is not None and value != fixed
        ):
            raise canopen.SdoAbortedError(Abort.VALUE_RANGE)
        if name in _COB_IDS:
            present = self.number(name)
            both_on = not (present | value) & unit_od.PDO_INVALID
            if not _LOWEST_PDO_COB_ID <= cob_id <= _HIGHEST_PDO_COB_ID or (
                both_on and (present ^ value) & _COB_ID_BITS
            ):
                raise canopen.SdoAbortedError(Abort.VALUE_RANGE)
        mapping = _object_name(od).endswith("mapping parameter")
        if mapping and value != od.default and (subindex or value):
            raise canopen.SdoAbortedError(Abort.NOT_MAPPABLE)
        if _object_name(od) == _ERRORS:
            self.errors.clear()
        try:
            if name == unit_od.FORCE_TABLE:
                self._scanner.forces.take_table(bytes(data))
            elif name == unit_od.FORCE_ZERO:
                self._scanner.forces.take_zero(bytes(data))
        except DamagedObject as error:
            raise canopen.SdoAbortedError(Abort.VALUE_RANGE) from error
        # The simulated unit takes no zero of its own, so it can only be told to have none.
        if name == "Tare.Command" and value != unit_od.TARE_CLEAR_SIGNATURE:
            raise canopen.SdoAbortedError(Abort.NOT_STORED)


def _object_name(od: ODVariable) -> str:
    """Return the name of a variable's object in the EDS, without that of the sub-index."""
    name: str = od.qualname.partition(".")[0]
    return name


class SimulatedControlUnit(CanopenDevice):
    """One control unit; it has no clock, the time is an argument."""

    def __init__(
        self,
        world: ScannedWorld,
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
        self._sync_id = 0
        self._force_due_s = math.inf
        self.scanner = Scanner(world, layout, self.faults)
        self.dictionary = UnitDictionary(
            self._node, layout, self.scanner, self.settings, self.faults
        )
        self.power_cycle()

    @property
    def state(self) -> str:
        """NMT state by the names of CiA 301: INITIALISING, PRE-OPERATIONAL, ..."""
        return str(self._node.nmt.state)

    def next_event_s(self) -> float:
        """Return the time in s of the unit's next own message; infinity: never."""
        return min(self._boot_due_s, self._network.next_due_s, self._force_due_s)

    def advance(self, now_s: float) -> None:
        """Let the time pass until ``now_s`` s: boot-up, heartbeat, force messages."""
        super().advance(now_s)
        while self._force_due_s <= now_s:
            self._send_force(self._force_due_s)
            self._force_due_s += self._force_period_s * self.faults.forces_each

    def _take(self, can_id: int, data: bytes) -> None:
        if can_id == unit_od.COB_NMT:
            self._nmt(data)
        elif self.state == _STOPPED:
            return
        elif can_id == self._sync_id:
            self._sync()
        elif can_id == self._node.sdo.rx_cobid:
            self._serve(data)
            self._time_forces()

    def command(self, state: str, now_s: float) -> None:
        """Carry out the NMT command for a state named in ``canopen.nmt.NMT_COMMANDS``."""
        command = bytes((NMT_COMMANDS[state], self.settings.node_id))
        self.receive(unit_od.COB_NMT, command, now_s)

    def emergency(self, code: int, *, register: int = REGISTER_GENERIC) -> None:
        """Report an error: EMCY, error register and history; code 0: all errors are cleared.

        Parameters
        ----------
        code
            Error code after CiA 301, 16 bit.
        register
            Bits of the error register that it sets.
        """
        dictionary = self.dictionary
        if code == 0:
            dictionary.error_register = 0
        else:
            dictionary.error_register |= register | REGISTER_GENERIC
            dictionary.errors.insert(0, code)
            del dictionary.errors[_MAX_HISTORY:]
        if not math.isfinite(self._boot_due_s) and self.state != _STOPPED:
            self._node.emcy.send(code, dictionary.error_register)

    def power_cycle(self) -> None:
        """Switch the power off and on: all values are defaults; boot-up after the boot."""
        self._reset(everything=True)

    def _reset(self, *, everything: bool) -> None:
        self._node.nmt.stop_heartbeat()
        self.dictionary.reset(everything=everything)
        if everything:
            self.scanner.reset()
        self._take_settings()
        self._burst_end_s = self._force_end_s = -math.inf
        self._force_due_s, self._force_period_s = math.inf, 0.0
        self._forces_lost = 0.0
        self._forces_later: deque[tuple[float, bytes]] = deque()
        self._boot_due_s = self._network.now_s + BOOT_S

    def _nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in {0, self.settings.node_id}:
            return
        if data[0] in RESETS:
            self._reset(everything=data[0] == NMT_COMMANDS["RESET"])
        elif data[0] in _CHANGES_OF_STATE:
            self._node.nmt.on_command(0, data, self._network.now_s)
            self._time_forces()

    def _take_settings(self) -> None:
        """Apply the values of the dictionary, after each SDO request and change of state."""
        dictionary = self.dictionary
        self._sync_id = dictionary.sync_cob_id
        self._window_s = 1e-6 * dictionary.number("Synchronous window length")
        self._frame_id = dictionary.pdo_cob_id(1)
        self._force_id = dictionary.pdo_cob_id(2) if self.settings.force_messages else None

    def _time_forces(self) -> None:
        """Start, continue or stop the event timer of the force messages."""
        self._take_settings()
        period_s = 0.0
        if self.settings.force_messages and self.state == _OPERATIONAL:
            period_s = 1e-3 * self.dictionary.number(unit_od.FORCES_TIMER)
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
        if self.state != _OPERATIONAL:
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
        if code not in self.dictionary.errors:
            self.emergency(code, register=REGISTER_MANUFACTURER)

    def _heartbeat_silenced(self) -> bool:
        return self.faults.dead or self.faults.heartbeat_off

    def _silenced(self) -> bool:
        return self.faults.dead
