"""The register map of the cell over Modbus, and the handshake of commands.

All values have 16 bits, so the word order does not matter. A command runs once, when `COMMAND_SEQ`
changes. After a reconnect a client first writes the acknowledged number. The page
``docs/reference/modbus.md`` describes the map.
"""

import itertools
import struct
from collections.abc import Sequence
from functools import partial
from math import degrees
from typing import Any, NamedTuple

from cell.control.part import Part
from cell.control.plan import Pose
from cell.control.states import CellState, GraspState
from cell.errors import CellError, ConfigError, NotInCommand, RequestRefused
from cell.fault_catalogue import Refusal, for_display
from cell.interfaces.access import read_secret, same_secret
from cell.interfaces.modbus.protocol import (
    DEVICE_BUSY,
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    ModbusError,
    ModbusServer,
)
from cell.service.service import Service
from recognition.recognizer import UNKNOWN

SIGNATURE = 0x5443
"""First input register ("TC"): a host that reads 0x4354 swaps the bytes."""

LIFE, COMMAND, OBJECT, FORCE, GRASPS, OPTIONS, KEY, HOLD, COMMAND_SEQ = range(9)
"""Holding registers. `OBJECT` is also the number of the pose (40, 41) or of parts to sort (24)."""
N_HOLDING, N_INPUT = 9, 136
SECRET_AT, N_SECRET = 32, 32
"""First holding register and number of registers of the secret, which cannot be read."""
TEXT_AT, REFUSAL_AT, N_LONG_TEXT = 32, 64, 32
"""First input registers of the texts of fault and last refusal; number of registers of each."""
KEEP_ALWAYS, KEEP_NAMED = 1, 2
"""Bits of `OPTIONS`: keep the part; keep it only if it was named."""
REBOOT = 4
"""Bit of `OPTIONS`: `clear` restarts servos with a fault."""

_REGISTERS = {"grasps": GRASPS, "max_grasps": GRASPS, "parts": OBJECT, "key": KEY}
"""Holding registers of fields that need no conversion."""
READY, REMOTE, RUNNING, DONE, REFUSED, FAULT, HOLDING, NO_PART, LOST, UNNAMED, NEEDS_RESET = (
    1 << bit for bit in range(11)
)
ON_HOLD, NOT_RECORDED = 1 << 11, 1 << 12
"""Bits of the third input register; `REMOTE`: Modbus has the lease, `ON_HOLD`: a client keeps the
cell on hold, `HOLDING`: a part may be in the grip, `NOT_RECORDED`: the recording has stopped."""


NOT_MEASURED = 0x8000
"""Force, opening or temperature that is not measured: -32768 as two's complement."""
OLDEST_MS = 0x7FFF
"""Largest age in ms, also of values never measured: large for signed and unsigned readers."""
ANSWERED, ANSWER_UNKNOWN, ANSWER_IN_GRIP = 1, 2, 4
"""Bits of the last identification: it has an answer; the answer is UNKNOWN; the part was kept."""


N_TEXT = 16
"""Registers of a text, two characters each."""


class Value(NamedTuple):
    """One value of a `Snapshot`."""

    kind: type
    """``int``, ``float`` or ``str``."""
    text: str
    """Meaning, with unit."""
    source: str
    """Path of its attributes."""
    register: int
    """Input register, for a text the first of `N_TEXT`."""
    unit: float = 1.0
    """Unit of the register."""

    def of(self, value: Any) -> Any:
        """Return the value; None if it does not exist or is not measured at the moment."""
        for name in self.source.split("."):
            if value is None:
                return None
            value = getattr(value, name)
        if self.kind is not str:
            return value
        return ", ".join(value) if isinstance(value, tuple) else value or ""


# fmt: off
VALUES = (
    Value(int, "State of the cell: number of PackTags", "status.state_number", 3),
    Value(int, "State of the grip, 0 to 7", "status.grasp_number", 4),
    Value(float, "Grip force in N", "status.live.force_n", 13, 0.01),
    Value(float, "Age in s of the newest valid force", "status.live.force_age_s", 23, 1e-3),
    Value(float, "Opening between the fingers in mm", "status.live.opening_mm", 14, 0.01),
    Value(float, "Temperature of the warmest servo in degrees Celsius",
          "status.live.temperature_c", 22),
    Value(int, "Number of the newest job; 0: none", "job.number", 8),
    Value(int, "State of the job: 1 accepted, 2 running, 4 done, 5 stopped on request, 6 aborted",
          "job.outcome_number", 9),
    Value(int, "Grasps of the newest part of the job; 0: none", "job.part.n_grasps", 12),
    Value(int, "Job of the last identification, until the next one begins; 0: no answer",
          "status.last_answer.job", 24),
    Value(int, "Last identification: id of the label, from 1; 0: UNKNOWN",
          "status.last_answer.label_id", 10),
    Value(float, "Last identification: probability of the label, 0 to 1",
          "status.last_answer.probability", 11, 1e-4),
    Value(float, "Last identification: size in mm; 0: not measured",
          "status.last_answer.size_mm", 15, 0.01),
    Value(int, "Number of the newest part of an identification or sort; 0: none since the start",
          "part.number", 96),
    Value(str, "Label of the part", "part.label", 104),
    Value(int, "Id of the label of the part, from 1; 0: UNKNOWN", "part.label_id", 97),
    Value(float, "Probability of the label of the part, 0 to 1", "part.probability", 98, 1e-4),
    Value(float, "Size of the part in mm; 0: not measured", "part.size_mm", 99, 0.01),
    Value(str, "Place where a sort released the part; empty: not sorted", "part.place", 120),
    Value(int, "Number of the place of the part, from 1, rejects last; 0: not sorted",
          "part.place_id", 100),
    Value(int, "Grasps of the identification of the part", "part.n_grasps", 101),
    Value(int, "Number of the pose that the cell waits for; 0: none", "pose_seq", 16),
    Value(float, "Age in s of the newest frame of the taxels", "status.live.frame_age_s", 21, 1e-3),
)
# fmt: on
"""All values with a register of their own; texts stand in the page on Modbus."""


class HostCommand(NamedTuple):
    """A task or command that starts a job."""

    name: str
    """Task of a goal, or command of the service."""
    fields: tuple[str, ...]
    """Its arguments; 0: the value of the config."""
    numbers: tuple[int, ...]
    """Commands that start it; numbers below 20 are CntrlCmd of PackTags."""
    text: str
    """Description."""


# fmt: off
COMMANDS = (
    HostCommand("teach", ("label", "grasps"), (20,), "Start to teach an object"),
    HostCommand("identify", ("max_grasps", "force_n", "keep"), (2, 21),
                "Start an identification; 0 grasps and 0 N: the values of the config"),
    HostCommand("grip", ("force_n",), (22,),
                "Start to grip a part; it is kept with `force_n`, at most `carry_force_n`"),
    HostCommand("verify", (), (23,), "Start to check whether the held part is still the same"),
    HostCommand("zero", (), (25,),
                "Start to measure the zero with the empty fingers closed on each other"),
    HostCommand("sort", ("parts", "max_grasps", "force_n"), (24,),
                "Start to sort parts to `sort.places`; not with a callback positioner"),
    HostCommand("release", ("key",), (30,),
                "Start to release the part, with key 20304 (0x4F50)"),
    HostCommand("clear", ("reboot",), (9,),
                "Start to acknowledge the fault; `reboot` restarts servos with a fault"),
    HostCommand("reset", (), (1,),
                "Start to verify the devices again, also after a shutdown"),
    HostCommand("shutdown", (), (3,),
                "Start to disconnect the devices; a held part stays held"),
)
# fmt: on
"""All commands."""


def _two(value: float, unit: float) -> int:
    """Return a value in units as 16 bit, two's complement, limited to the range of a register."""
    return max(-0x7FFF, min(0x7FFF, round(value / unit))) & 0xFFFF


def _word(value: Value, value_si: Any) -> int:
    """Return a value as register; numbers wrap around after 65535."""
    if value.kind is int:
        return (value_si or 0) & 0xFFFF
    if ".live." not in value.source:
        return _two(value_si or 0.0, value.unit)
    if value.source.endswith("age_s"):
        return OLDEST_MS if value_si is None else min(OLDEST_MS, round(value_si / value.unit))
    return NOT_MEASURED if value_si is None else _two(value_si, value.unit)


def _text(text: str, n_registers: int = N_LONG_TEXT) -> list[int]:
    """Return the beginning of a text, two characters per register."""
    encoded = text.encode("ascii", "replace")[: 2 * n_registers].ljust(2 * n_registers, b"\0")
    return list(struct.unpack(f">{n_registers}H", encoded))


def input_registers(
    service: Service, *, life: int, remote: bool, seq: int, result: int, refusal: Refusal
) -> list[int]:
    """Return all input registers of this moment."""
    now = service.snapshot()
    status, job, pose = now.status, now.job, now.pose or Pose()
    answer, part = status.last_answer or Part(), job.part or Part()
    held, same = (True, True) if (check := job.verification) is None else (check.held, check.same)
    flags = (
        (ANSWERED, answer.number > 0),
        (ANSWER_UNKNOWN, answer.label == UNKNOWN),
        (ANSWER_IN_GRIP, answer.in_grip),
    )
    bits = (
        (READY, status.state == CellState.IDLE),
        (REMOTE, remote),
        (RUNNING, job.outcome_number in (1, 2)),
        (DONE, job.outcome_number >= 4),
        (REFUSED, result != 0),
        (FAULT, status.fault is not None),
        (HOLDING, status.holding),
        (NO_PART, status.grasp == GraspState.NO_PART_FOUND or not held),
        (LOST, status.grasp == GraspState.PART_LOST),
        (UNNAMED, part.label == UNKNOWN or same is False),
        (NEEDS_RESET, status.needs_reset),
        (ON_HOLD, bool(now.held_by)),
        (NOT_RECORDED, bool(status.recording_fault)),
    )
    words = [0] * N_INPUT
    for value in VALUES:
        value_si = value.of(now)
        if value.kind is str:
            words[value.register : value.register + N_TEXT] = _text(value_si or "", N_TEXT)
        else:
            words[value.register] = _word(value, value_si)
    words[:3] = SIGNATURE, life, sum(bit for bit, on in bits if on)
    words[5:8] = seq, result, status.fault_number or job.fault_number
    words[17:21] = (
        _two(pose.x_m, 1e-5),
        _two(pose.y_m, 1e-5),
        _two(degrees(pose.rotation_rad), 0.1),
        _two(degrees(pose.roll_rad), 0.1),
    )
    words[25:28] = sum(bit for bit, on in flags if on), refusal.number, service.boot
    on_hold = f"on hold by {', '.join(now.held_by)}" if now.held_by else ""
    if status.fault:
        text = for_display(status.fault_number, status.fault)
    else:
        text = on_hold or for_display(job.fault_number, job.error)
    words[TEXT_AT:REFUSAL_AT] = _text(text)
    words[REFUSAL_AT : REFUSAL_AT + N_LONG_TEXT] = _text(refusal.text)
    return words


class ModbusInterface(ModbusServer):
    """The cell behind Modbus TCP; one connection at a time writes.

    Raises OSError if it cannot listen at the configured address and port, or cannot read the file
    of the secret. Raises ConfigError if the secret is too short or too long.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        config = service.config.serve
        self._life = itertools.count()
        self._holding = [0] * N_HOLDING
        self._lease = 0
        self._owner: _Client | None = None
        self._host = ""
        self._synchronous = False
        self._seq = 0
        self._result = 0
        self._secret = read_secret(config.secret_file) if config.secret_file else ""
        if len(self._secret) > 2 * N_SECRET:
            raise ConfigError(
                f"{config.secret_file}: a secret for Modbus has at most {2 * N_SECRET} characters, "
                f"not {len(self._secret)}"
            )
        super().__init__(config, config.modbus_port or 0, partial(_Client, self))

    # All of the following runs on the event loop.

    def read(self, client: "_Client", function: int, address: int, count: int) -> Sequence[int]:
        """Return registers; see `cell.interfaces.modbus.protocol.Registers`."""
        if address + count > (N_HOLDING if function == 3 else N_INPUT):
            raise ModbusError(ILLEGAL_ADDRESS)
        if function == 3:
            self._holding[HOLD] = client.hold  # each client has its own hold
            return self._holding[address : address + count]
        everything = input_registers(
            self._service,
            life=next(self._life) & 0xFFFF,
            remote=self._has_lease(),
            seq=self._seq,
            result=self._result,
            refusal=client.refusal,
        )
        return everything[address : address + count]

    def write(self, client: "_Client", address: int, values: Sequence[int]) -> None:
        """Write registers of the client in command, and hold or the secret of any client."""
        if address >= SECRET_AT and address + len(values) <= SECRET_AT + N_SECRET:
            client.secret[address - SECRET_AT : address - SECRET_AT + len(values)] = values
            return
        if address + len(values) > N_HOLDING:
            raise ModbusError(ILLEGAL_ADDRESS)
        new = dict(enumerate(values, start=address))
        if HOLD in new:
            # First, and for any client: a hold also works in a block that is refused.
            client.hold = new[HOLD]
            if client.hold:
                self._service.begin_stop(client, client.name, connected=True)
            else:
                self._service.end_stop(client)
        if list(new) == [HOLD]:
            return
        self._command(client, new)
        self._holding[address : address + len(values)] = values
        seq = new.get(COMMAND_SEQ, self._seq)
        if seq != self._seq:
            # Noted before it runs: so it never runs again, whatever its result.
            self._seq = seq
            refusal = self._run()
            self._result = refusal.number
            if refusal.number:
                client.refusal = refusal
            self._holding[KEY] = 0

    def disconnected(self, client: "_Client") -> None:
        """Keep the hold of this client, and the lease for its host until the lease expires."""
        self._service.leave_stop(client)
        if client is self._owner:
            self._owner = None

    def _has_lease(self) -> bool:
        return self._service.lease.has(self._lease)

    def _command(self, client: "_Client", new: dict[int, int]) -> None:
        """Check that the client may write, and give or keep the lease with its life counter."""
        if client is not self._owner and self._secret:
            given = struct.pack(f">{N_SECRET}H", *client.secret).rstrip(b"\0").decode("latin-1")
            if not same_secret(given, self._secret):
                client.refuse(RequestRefused("write the secret to registers 32 to 63 first"))
                raise ModbusError(ILLEGAL_VALUE)
        mine = self._has_lease()
        lives = LIFE in new and new[LIFE] != self._holding[LIFE]
        inherits = self._owner is None and self._host == client.host
        if mine and client is not self._owner and not inherits:
            client.refuse(NotInCommand(f"Modbus {self._host} is in command; wait until it ends"))
            raise ModbusError(DEVICE_BUSY)
        known = mine and client is self._owner and self._synchronous
        seq = new.get(COMMAND_SEQ)
        if seq is not None and not known and seq != self._seq:
            # A block of an earlier connection must not run again.
            client.refuse(RequestRefused(f"write {self._seq} to register 8 first, as acknowledged"))
            raise ModbusError(ILLEGAL_VALUE)
        try:
            if not mine:
                if not (lives or self._service.lease.number):
                    raise NotInCommand("change register 0, the life counter, to get the lease")
                self._lease = self._service.lease.acquire(client.name)
            elif lives:
                self._service.lease.alive(self._lease)
        except NotInCommand as error:
            client.refuse(error)
            raise ModbusError(DEVICE_BUSY) from None
        if client is not self._owner:
            # Registers that another connection wrote in part are discarded.
            self._holding = [0] * N_HOLDING
            self._holding[COMMAND_SEQ] = self._seq
        self._owner, self._host = client, client.host
        self._synchronous = known or seq is not None

    def _run(self) -> Refusal:
        """Carry the command out and return its refusal; number 0: not refused."""
        asked = self._holding
        service, number = self._service, asked[COMMAND]
        try:
            match number:
                case 4:
                    service.stop("by its client over Modbus")
                case 40 | 41:
                    service.pose_reached(self._lease, asked[OBJECT], ok=number == 40)
                case _ if number in _COMMANDS:
                    if asked[OPTIONS] >= 2 * REBOOT:
                        raise RequestRefused(f"options {asked[OPTIONS]}: use bits 0 to 2")
                    name, fields, *_ = _COMMANDS[number]
                    given = {field: _field(service, asked, field) for field in fields}
                    service.request(self._lease, name, **given)
                case _:
                    numbers = sorted((4, 40, 41, *_COMMANDS))
                    raise RequestRefused(f"command {number} is not one of {numbers}")
        except Exception as error:
            return Refusal.of(error)
        return Refusal()


class _Client:
    """One connection; implements `cell.interfaces.modbus.protocol.Registers`."""

    def __init__(self, interface: ModbusInterface, host: str) -> None:
        self.host = host
        self.name = f"Modbus {host}"
        self.hold = 0
        self.secret = [0] * N_SECRET
        self.refusal = Refusal()
        self.read = partial(interface.read, self)
        self.write = partial(interface.write, self)
        self.disconnected = partial(interface.disconnected, self)

    def refuse(self, error: CellError) -> None:
        """Store the reason of the exception that answers a request of this client."""
        self.refusal = Refusal.of(error)


_COMMANDS = {number: command for command in COMMANDS for number in command.numbers}
"""Command of each number; further numbers: 4 hold, 40 pose reached, 41 pose refused."""


def _field(service: Service, asked: Sequence[int], name: str) -> Any:
    """Return a field of a command from the registers of the host."""
    match name:
        case "label":
            labels = service.plugin.labels_by_id
            if not 1 <= asked[OBJECT] <= len(labels):
                raise RequestRefused(f"object {asked[OBJECT]} has no label; serve.objects names it")
            return labels[asked[OBJECT] - 1]
        case "force_n":
            return 0.01 * asked[FORCE]
        case "keep":
            options = {KEEP_ALWAYS: "always", KEEP_NAMED: "when_named"}
            return next((how for bit, how in options.items() if asked[OPTIONS] & bit), "")
        case "reboot":
            return bool(asked[OPTIONS] & REBOOT)
        case _:
            return asked[_REGISTERS[name]]
