"""One CiA 402 drive: state machine, profile position, homing, quick stop, supervision.

All access is by SDO: it needs no PDO mapping, and each write is confirmed. A moving drive is polled
some hundred times a second, a standing one is not polled.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from canopen.nmt import NMT_COMMANDS, NMT_STATES
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from motion import object_dictionary as od
from motion.bus import HOST_NODE, DriveBus
from motion.errors import (
    AxisAnswerWrong,
    AxisDuplicated,
    AxisFault,
    AxisLimitExceeded,
    AxisMissing,
    AxisNotOperational,
    AxisRestarted,
    AxisSilent,
    HomingFailed,
    LimitSwitchReached,
)
from motion.object_dictionary import Control, HomingMethod, ModeOfOperation, State, Status
from tactile.can.sdo_client import (
    COB_SDO_REQUEST,
    COB_SDO_RESPONSE,
    PolledSdoClient,
    SdoNotAnswered,
)

HEARTBEAT_S = 0.05
"""Period in s of the drive's heartbeat (1017h)."""
_HOST_LOST_FACTOR = 2.0
"""Time after which a drive without its host stops, over that after which it counts as lost."""
_SDO_SHARE = 0.4
"""Share of that time for one answer: at 125 ms fifty times the time of a drive."""
_ATTEMPTS = 3
"""Attempts of a transfer without an answer; a lost heartbeat ends them earlier."""
_START_S = 3.0
"""Longest time in s until a drive has booted and sends heartbeats."""
_STATE_S = 2.0
"""Longest time in s for a change of state: brakes and power stages take their time."""
_POLL_S = 0.005
"""Period in s of the polls of a moving drive."""
_BOOT_UP, _STOPPED, _OPERATIONAL = 0, 4, 5
"""States in a heartbeat (CiA 301, 7.2.8.3.3)."""
_STATE_BITS = 0x7F
"""The bits of a heartbeat that are the state."""
_SURPLUS_ANSWERS = 3
"""Surplus of SDO answers over requests that shows a second drive; one may be a double message."""
_EMCY_CODE_BYTES = 2
"""Length of the code at the start of an emergency message (CiA 301, 7.2.7)."""
_ANSWER_REMEDY = (
    "the drive is another one than CiA 402 describes, or somebody else sends with its node-ID. "
    "Check drive, firmware and node-IDs, then clear the fault and start again"
)
_QUICK_STOP_REQUEST = struct.pack("<BHBHH", 0x2B, 0x6040, 0, Control.QUICK_STOP, 0)
"""SDO request that writes a controlword of two bytes (CiA 301, 7.2.4.3.3)."""

_NEXT = {
    State.SWITCH_ON_DISABLED: Control.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Control.SWITCH_ON,
    State.SWITCHED_ON: Control.ENABLE_OPERATION,
    # The direct way back, transition 16, is optional (CiA 402-2).
    State.QUICK_STOP_ACTIVE: Control.DISABLE_VOLTAGE,
}
"""Controlword that leads from each state towards OPERATION ENABLED."""
_AT_FAULT = (State.FAULT, State.FAULT_REACTION_ACTIVE)
"""States of a drive at fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveSettings:
    """Set-up of a drive in its own increments; written at each preparation and read back."""

    low: int
    high: int
    """Software position limits (607Dh)."""
    velocity: int
    acceleration: int
    """Profile velocity (6081h) in increments/s and acceleration (6083h, 6084h) in increments/s²;
    the quick stop brakes twice as hard."""
    window: int
    """Position window (6067h): largest distance of a reached target."""
    following_error: int
    """Following error window (6065h) beyond which the drive goes to fault."""
    homing: HomingMethod | None
    """Homing method; None for a drive with an absolute encoder."""
    home: int
    """Position at the home (607Ch)."""
    homing_velocity: int
    """Speed to the switch in increments/s; back from it a fifth."""


_FOLLOWING_MS, _WINDOW_MS = 50, 20
"""Time in ms of an allowed following error, and least time in ms at a reached position."""
_STILL_SHARE = 0.01
"""Largest speed of a standing drive as a share of its profile velocity: encoders have noise."""
_ZERO_SPEED_SHARE = 5
"""Speed of the search for a switch over the speed away from it."""


class Cia402Drive:
    """One drive on the bus; positions in increments."""

    def __init__(self, bus: DriveBus, node_id: int, name: str, settings: DriveSettings) -> None:
        self.name = f"{name} (drive {node_id})"
        self._bus = bus
        self._node_id = node_id
        self._settings = settings
        self._objects: Any = od.of_node(node_id)
        self._client = PolledSdoClient(
            node_id=node_id,
            dictionary=self._objects,
            clock=bus.clock,
            service=bus.service,
            wait=bus.wait,
            timeout_s=_SDO_SHARE * bus.loss_s,
        )
        self._client.network = bus  # it names the failures of the interface
        self._heard_s = 0.0
        self._nmt_state = _OPERATIONAL
        self._surplus = 0
        self._booted = False
        self._emergency = 0
        self._supervised = self._stopped = False
        self.target: int | None = None
        bus.subscribe(COB_SDO_RESPONSE + node_id, self._client.on_response)
        bus.subscribe(od.COB_HEARTBEAT + node_id, self._on_heartbeat)
        bus.subscribe(od.COB_EMCY + node_id, self._on_emergency)

    # -- the interface of an axis ----------------------------------------------------------------

    def identify(self) -> str:
        """Return state and position in words; nothing is changed and nothing moves.

        Raises AxisMissing without an answer, or if the device is not a CiA 402 drive with the
        needed modes. Raises AxisNotOperational if it is stopped, AxisDuplicated for two drives.
        """
        self._supervised, self._nmt_state = False, _OPERATIONAL
        self._surplus = self._client.surplus
        try:
            kind = self._read("Device type")
            modes = self._read("Supported drive modes")
        except AxisSilent as error:
            raise AxisMissing(f"{error}; also check its node-ID and the bit rate") from error
        if kind & 0xFFFF != od.PROFILE_402:
            raise AxisMissing(
                f"{self.name} has device type {kind:08X}h, which is no CiA 402 drive: correct the "
                "node-ID"
            )
        needed = [ModeOfOperation.PROFILE_POSITION]
        if self._settings.homing is not None:
            needed.append(ModeOfOperation.HOMING)
        for mode in needed:
            if not modes >> (mode - 1) & 1:
                raise AxisMissing(
                    f"{self.name} has no mode {mode.name} (6502h is {modes:08X}h): use another "
                    "drive, or an absolute encoder with homing: none"
                )
        state = self._state()
        words = f"{state.words}, position {self.position} increments"
        if state is State.FAULT:
            words += f", {od.error_code_text(self._read('Error code'))}"
        self._bus.watch.pause(_POLL_S)
        self.check()
        return words

    def prepare(self, *, reset: bool) -> None:
        """Set the drive up, enable it and find its home; the axis may move.

        A drive at fault is reset with ``reset`` only. Raises MotionError if it is missing, stays at
        fault, refuses its set-up or does not find its home.
        """
        self._bus.drop_old()
        self._command("OPERATIONAL")  # a stopped drive answers no SDO
        self.identify()
        self._booted, self._emergency, self._nmt_state = False, 0, _BOOT_UP
        self._command("OPERATIONAL")  # a booting drive missed the first command
        self._write("Producer heartbeat time", round(1e3 * HEARTBEAT_S))
        self._until(
            lambda: self._nmt_state == _OPERATIONAL,
            _START_S,
            "sends no heartbeat as operational: look for another CANopen master",
            AxisNotOperational,
        )
        if self._state() is State.OPERATION_ENABLED:
            # It may still move: a silent drive could not be stopped.
            self._write("Controlword", Control.QUICK_STOP)
            self._until(self.standing, self._braking_s, "does not stop")
        self._set_up()
        if reset:
            self._reset_fault()
        self._emergency = 0
        self._supervised = True
        self._enable()
        if self._settings.homing is not None:
            self._home(self._settings.homing)
        self._set_mode(ModeOfOperation.PROFILE_POSITION)

    def clear_fault(self, *, reboot: bool) -> None:
        """Clear the fault of the drive, without a restart; it is not enabled and does not move.

        Raises MotionError if it is missing, or its fault stays.
        """
        del reboot
        self._command("OPERATIONAL")
        self.identify()
        self._reset_fault()

    def wake(self) -> None:
        """Check that the drive still answers, is enabled and has no fault."""
        self._bus.drop_old()
        self._heard_s = self._bus.clock.monotonic()
        self._surplus = self._client.surplus
        self._supervised = True
        if self._stopped and self._state() is State.QUICK_STOP_ACTIVE:
            self._enable()
        self._stopped = False
        status = self._status()
        if State.of(status) is State.SWITCH_ON_DISABLED:
            raise AxisRestarted(
                f"{self.name} is in SWITCH ON DISABLED, it was in OPERATION ENABLED: it has "
                "restarted, or another program commands it; clear the fault and start again"
            )
        self._check_status(status)

    def go_to(self, target: int) -> None:
        """Begin to move; the only place where a target is written, and its limits with it.

        Raises AxisLimitExceeded if the target is outside the software limits; nothing moves.
        """
        low, high = self._settings.low, self._settings.high
        if not low <= target <= high:
            raise AxisLimitExceeded(
                f"{self.name} was asked for {target} increments, its limits are {low} to {high}"
            )
        # The monitored node-ID, and its longest silence in ms (CiA 301, 1016h).
        host_lost_ms = round(1e3 * _HOST_LOST_FACTOR * self._bus.loss_s)
        self._write("Consumer heartbeat time.Host", HOST_NODE << 16 | host_lost_ms)
        self._bus.beat()
        self._write("Target position", target)
        self.target = target
        self._write("Controlword", Control.NEW_SET_POINT)
        self._until(
            lambda: bool(self._status() & Status.ACKNOWLEDGED), _STATE_S, "takes no set-point"
        )
        self._write("Controlword", Control.ENABLE_OPERATION)
        self._until(
            lambda: not self._status() & Status.ACKNOWLEDGED, _STATE_S, "keeps its set-point"
        )

    def arrived(self) -> bool:
        """Return whether the target is reached: by the statusword and by the position.

        Raises MotionError if the drive is at fault, silent, restarted, or stopped by a limit
        switch.
        """
        self.check()
        status = self._status()
        self._check_status(status)
        if self.target is None or not status & Status.TARGET_REACHED:
            return False
        return abs(self.position - self.target) <= self._settings.window

    def rest(self) -> None:
        """End the drive's supervision of the host's heartbeat."""
        self._write("Consumer heartbeat time.Host", 0)

    @property
    def position(self) -> int:
        """Present position in increments (6064h)."""
        return self._read("Position actual value")

    def stop(self) -> None:
        """Send a quick stop without a wait; a silent drive may still receive it."""
        self.target, self._stopped = None, True
        if self._nmt_state == _STOPPED:
            self._command("PRE-OPERATIONAL")  # else it receives no SDO
        self._bus.send_message(COB_SDO_REQUEST + self._node_id, _QUICK_STOP_REQUEST)

    def standing(self) -> bool:
        """Return whether the axis stands still after a stop."""
        self._supervised = False
        still = abs(self._read("Velocity actual value")) <= self._settings.velocity * _STILL_SHARE
        return still and self._state() is not State.OPERATION_ENABLED

    def check(self) -> None:
        """Raise an error from heartbeat, emergencies and answers since the last check."""
        self._bus.service()
        surplus = self._client.surplus - self._surplus
        if surplus >= _SURPLUS_ANSWERS:
            raise AxisDuplicated(
                f"{self.name} sent {surplus} SDO answers more than there were requests: a second "
                "drive has the same node-ID, or another program uses it. Leave one of them on the "
                "bus, then clear the fault and start again"
            )
        if not self._supervised:
            return
        if self._booted:
            raise AxisRestarted(
                f"{self.name} has booted: its position is lost. Check its supply, then clear the "
                "fault and start again; it is homed again"
            )
        if self._nmt_state != _OPERATIONAL:
            raise self._not_operational()
        if self._emergency:
            raise AxisFault(self._fault_text(self._emergency))
        limit_s = self._bus.loss_s
        silent_s = self._bus.clock.monotonic() - self._heard_s
        if silent_s > limit_s:
            raise AxisSilent(
                f"no heartbeat from {self.name} for {silent_s:.3f} s, allowed are {limit_s:g} s; "
                "its position is unknown. Check its supply and CAN cable, then clear the "
                "fault and start again"
            )

    @property
    def _braking_s(self) -> float:
        return _STATE_S + self._settings.velocity / self._settings.acceleration

    # -- parts -----------------------------------------------------------------------------------

    def _command(self, command: str) -> None:
        """Command an NMT state."""
        self._bus.send_message(od.COB_NMT, bytes((NMT_COMMANDS[command], self._node_id)))

    def _not_operational(self) -> AxisNotOperational:
        state = NMT_STATES.get(self._nmt_state, "unknown").lower()
        return AxisNotOperational(
            f"{self.name} is in the NMT state {state}, it has to be operational: another CANopen "
            "master has commanded it. Look for that master, then clear the fault and start again: "
            "the next motion makes the drive operational"
        )

    def _set_up(self) -> None:
        wanted = self._settings
        for name, value in (
            ("Software position limit.Min position limit", wanted.low),
            ("Software position limit.Max position limit", wanted.high),
            ("Following error window", wanted.following_error),
            ("Following error time out", _FOLLOWING_MS),
            ("Position window", wanted.window),
            ("Position window time", _WINDOW_MS),
            ("Profile velocity", wanted.velocity),
            ("Profile acceleration", wanted.acceleration),
            ("Profile deceleration", wanted.acceleration),
            ("Quick stop deceleration", 2 * wanted.acceleration),
            ("Quick stop option code", od.STAY_IN_QUICK_STOP),
            ("Abort connection option code", od.STOP_WHEN_HOST_IS_LOST),
            ("Consumer heartbeat time.Host", 0),
        ):
            self._write(name, value)
            if (answer := self._read(name)) != value:
                raise AxisMissing(
                    f"{self.name} keeps {answer} in {self._place(name)} instead of {value}: "
                    "correct the config or the drive's own limits"
                )

    def _enable(self) -> None:
        def enabled() -> bool:
            state = self._state()
            if state in _AT_FAULT:
                raise AxisFault(self._fault_text(self._read("Error code")))
            if state in _NEXT:
                self._write("Controlword", _NEXT[state])
            return state is State.OPERATION_ENABLED

        failure = "is not enabled: check its power stage, enable input and safe torque off"
        self._until(enabled, _STATE_S, failure, AxisMissing)

    def _reset_fault(self) -> None:
        if self._state() not in _AT_FAULT:
            return
        code = self._read("Error code")
        self._write("Controlword", Control.DISABLE_VOLTAGE)
        self._write("Controlword", Control.FAULT_RESET)
        self._until(
            lambda: self._state() not in _AT_FAULT,
            _STATE_S,
            f"stays at fault, {od.error_code_text(code)}: remedy its cause",
            AxisFault,
        )

    def _home(self, method: HomingMethod) -> None:
        wanted = self._settings
        slow = max(1, wanted.homing_velocity // _ZERO_SPEED_SHARE)
        self._set_mode(ModeOfOperation.HOMING)
        self._write("Homing method", method)
        self._write("Home offset", wanted.home)
        self._write("Homing speeds.Speed during search for switch", wanted.homing_velocity)
        self._write("Homing speeds.Speed during search for zero", slow)
        self._write("Homing acceleration", wanted.acceleration)
        self._write("Controlword", Control.START_HOMING)
        # The longest travel: from one end to the other, and back from the switch.
        longest_s = _STATE_S + 2.0 * (wanted.high - wanted.low) / wanted.homing_velocity

        def attained() -> bool:
            self.check()
            status = self._status()
            if status & Status.MODE_ERROR:
                raise HomingFailed(f"{self.name} reports a homing error: check its switch")
            self._check_state(State.of(status))
            return bool(status & Status.ACKNOWLEDGED and status & Status.TARGET_REACHED)

        self._until(attained, longest_s, "has not found its home: check its switch", HomingFailed)
        self._write("Controlword", Control.ENABLE_OPERATION)

    def _set_mode(self, mode: ModeOfOperation) -> None:
        self._write("Modes of operation", mode)
        self._until(
            lambda: self._read("Modes of operation display") == mode,
            _STATE_S,
            f"does not take mode {mode.name}",
        )

    def _check_status(self, status: int) -> None:
        self._check_state(State.of(status))
        if status & Status.INTERNAL_LIMIT:
            inputs = self._read("Digital inputs")
            which = {od.INPUT_NEGATIVE_SWITCH: "negative ", od.INPUT_POSITIVE_SWITCH: "positive "}
            raise LimitSwitchReached(
                f"{self.name} is stopped by its {which.get(inputs & 3, '')}limit switch at "
                f"{self.position} increments: check home and limits, then "
                "clear the fault and start again; it is homed again"
            )

    def _check_state(self, state: State) -> None:
        if state in _AT_FAULT:
            raise AxisFault(self._fault_text(self._read("Error code")))
        if state is not State.OPERATION_ENABLED:
            raise AxisFault(
                f"{self.name} left OPERATION ENABLED for {state.words}: check its enable input, "
                "safe torque off and other masters, then clear the fault and start again"
            )

    def _fault_text(self, code: int) -> str:
        return (
            f"{self.name} is at fault, {od.error_code_text(code)}; remedy the cause, then clear "
            "the fault and start again"
        )

    def _until(
        self,
        condition: Callable[[], bool],
        timeout_s: float,
        failure: str,
        error: type[Exception] = AxisFault,
    ) -> None:
        end_s = self._bus.clock.monotonic() + timeout_s
        while not condition():
            if self._bus.clock.monotonic() > end_s:
                raise error(f"{self.name} {failure} (waited {timeout_s:g} s)")
            self._bus.watch.pause(_POLL_S)
            self.check()

    def _state(self) -> State:
        return State.of(self._status())

    def _status(self) -> int:
        status = self._read("Statusword")
        try:
            State.of(status)
        except ValueError as error:
            raise AxisAnswerWrong(
                f"{self.name} sends the statusword {status:04X}h, which is no state of CiA 402: "
                f"{_ANSWER_REMEDY}"
            ) from error
        return status

    def _read(self, name: str) -> int:
        variable = self._objects[name]
        data = self._transfer("read", name, self._client.upload)
        if 8 * len(data) != len(variable):
            raise AxisAnswerWrong(
                f"{self.name} sends {self._place(name)} with a length of {len(data)} instead of "
                f"{len(variable) // 8} bytes: {_ANSWER_REMEDY}"
            )
        return int(variable.decode_raw(data))

    def _write(self, name: str, value: int) -> None:
        data = self._objects[name].encode_raw(int(value))
        self._transfer("write", name, self._client.download, data)

    def _place(self, name: str) -> str:
        variable = self._objects[name]
        return f"{variable.index:04X}h:{variable.subindex}"

    def _transfer(self, verb: str, name: str, transfer: Any, *data: bytes) -> Any:
        variable, failure = self._objects[name], None
        for _ in range(_ATTEMPTS):
            self.check()
            try:
                return transfer(variable.index, variable.subindex, *data)
            except SdoCommunicationError as error:
                failure = error
            except SdoAbortedError as error:
                raise AxisMissing(
                    f"{self.name} refused to {verb} {self._place(name)} ({error}): the drive "
                    "does not have what CiA 402 asks for, or its limits are narrower"
                ) from error
        self.check()
        if self._nmt_state == _STOPPED:
            raise self._not_operational()
        asked = f"{verb} of {self._place(name)}, {_ATTEMPTS} times"
        if not isinstance(failure, SdoNotAnswered):
            raise AxisAnswerWrong(
                f"{self.name} answers wrongly ({asked}; {failure}): {_ANSWER_REMEDY}"
            ) from failure
        raise AxisSilent(
            f"{self.name} does not answer ({asked}): check its supply and CAN cable"
        ) from failure

    def _on_heartbeat(self, _cob_id: int, data: bytearray, _time_s: float) -> None:
        self._heard_s = self._bus.clock.monotonic()
        # Some drives send a boot-up without data.
        self._nmt_state = data[0] & _STATE_BITS if data else _BOOT_UP
        self._booted = self._booted or self._nmt_state == _BOOT_UP

    def _on_emergency(self, _cob_id: int, data: bytearray, _time_s: float) -> None:
        # A short message with its code is an emergency, too: its sender has an error.
        if len(data) >= _EMCY_CODE_BYTES:
            code = int.from_bytes(data[:_EMCY_CODE_BYTES], "little")
            self._emergency = code or self._emergency
