"""CiA 402 drives on a CAN bus: state machine, profile position, homing, quick stop, supervision.

All access is by SDO: it needs no PDO mapping, and each write is confirmed, except the quick stop of
`Cia402Drive.stop`. A moving drive is polled some hundred times a second, a standing one is not
polled. States, controlwords and modes are those of canopen's profile 402. canopen's ``BaseNode402``
is not used: it waits by the computer's clock, and has no set-point and no limits.
"""

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import can
import canopen
from canopen.nmt import NMT_COMMANDS, NMT_STATES
from canopen.profiles.p402 import OperationMode, State402

from motion import errors, object_dictionary as od
from motion.axes import POLL_S, Axis, AxisSettings, Watch
from motion.object_dictionary import HomingMethod, Status
from tactile.can.bus import PolledSource, of_another_kind
from tactile.can.sdo_client import PolledSdoClient, SdoNotAnswered
from tactile.errors import LinkFault, NodeMissing, ObjectRefused

_HOST_NODE = 127
"""Node-ID of the host's own heartbeat: the last one, which no drive here has."""
_HOST_HEARTBEAT_S = 0.05
"""Period in s of that heartbeat while an axis moves."""
HEARTBEAT_S = 0.05
"""Period in s of the drive's heartbeat (1017h)."""
_HOST_LOST_FACTOR = 2.0
"""Time after which a drive without its host stops, over that after which it counts as lost."""
_SDO_SHARE = 0.4
"""Share of that time for one answer: at 125 ms fifty times the time of a drive."""
_START_S = 3.0
"""Longest time in s until a drive has booted and sends heartbeats."""
_STATE_S = 2.0
"""Longest time in s for a change of state: brakes and power stages take their time."""
_BOOT_UP, _STOPPED, _OPERATIONAL = 0, 4, 5
"""States in a heartbeat (CiA 301, 7.2.8.3.3)."""
_STATE_BITS = 0x7F
"""The bits of a heartbeat that are the state."""
_SURPLUS_ANSWERS = 3
"""Surplus of SDO answers over requests that shows a second drive; one may be a double message."""
_FOLLOWING_MS, _WINDOW_MS = 50, 20
"""Time in ms of an allowed following error, and least time in ms at a reached position."""
_STILL_SHARE = 0.01
"""Largest speed of a standing drive as a share of its profile velocity: encoders have noise."""
_ZERO_SPEED_SHARE = 5
"""Speed of the search for a switch over the speed away from it."""
_QUICK_STOP_REQUEST = struct.pack("<BHBHH", 0x2B, 0x6040, 0, State402.CW_QUICK_STOP, 0)
"""SDO request that writes a controlword of two bytes (CiA 301, 7.2.4.3.3)."""

_NEXT = {
    "SWITCH ON DISABLED": State402.CW_SHUTDOWN,
    "READY TO SWITCH ON": State402.CW_SWITCH_ON,
    "SWITCHED ON": State402.CW_OPERATION_ENABLED,
    "QUICK STOP ACTIVE": State402.CW_DISABLE_VOLTAGE,
}
"""Controlword that leads from each state towards OPERATION ENABLED."""
_AT_FAULT = ("FAULT", "FAULT REACTION ACTIVE")
"""States of a drive at fault."""


class DriveBus(canopen.Network):
    """CAN bus of one to three drives, used by the thread that moves them; canopen dispatches.

    Parameters
    ----------
    loss_s
        Time in s without a heartbeat after which a drive is lost.
    """

    def __init__(self, bus: can.BusABC, watch: Watch, loss_s: float) -> None:
        super().__init__(bus)
        self.watch = watch
        self.loss_s = loss_s
        self._source = PolledSource(bus, watch.clock)
        self._beat_due_s = math.inf

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a message. Raises AxisSilent when the interface fails."""
        with _failures_named():
            super().send_message(can_id, data, remote)

    def beat(self) -> None:
        """Start the host's heartbeat, for drives that stop without it."""
        self._beat_due_s = self.watch.clock.monotonic() + _HOST_HEARTBEAT_S
        self.send_message(od.COB_HEARTBEAT + _HOST_NODE, bytes((_OPERATIONAL,)))

    def service(self) -> None:
        """Pass on received messages, and send the heartbeat when it is due.

        Raises AxisSilent when the interface fails.
        """
        if self.watch.clock.monotonic() >= self._beat_due_s:
            self.beat()
        with _failures_named():
            messages = self._source.drain()
        for _, message in messages:
            # Error frames are not used: a disturbed controller shows by missing heartbeats,
            # here within `loss_s`, and at the drives.
            unusable = message.is_error_frame or len(message.data) != message.dlc
            if unusable or of_another_kind(message):
                continue
            self.notify(message.arbitration_id, message.data, message.timestamp)

    def drop_old(self) -> None:
        """Drop messages from the time without polls; a boot-up among them still counts."""
        self.service()
        with _failures_named():
            self._source.start()

    def wait(self, most_s: float) -> None:
        """Wait for at most ``most_s`` s under supervision."""
        self._source.wait(most_s)
        self.watch.look()


@contextmanager
def _failures_named() -> Iterator[None]:
    try:
        yield
    except (can.CanError, OSError, LinkFault) as error:
        raise errors.AxisSilent(
            f"the CAN interface of the axes failed: {error}; the axes cannot be stopped over it. "
            "Check the adapter, use the emergency stop where an axis still moves"
        ) from error


@dataclass(frozen=True, kw_only=True)
class DriveSettings(AxisSettings):
    """An axis with a drive; the set-up is written at each preparation and read back.

    Beyond ``lag`` the drive goes to fault (following error, 6065h); its quick stop brakes twice as
    hard as its profile.
    """

    node_id: int
    """CANopen node-ID."""
    homing: HomingMethod | None
    """Homing method of an axis that counts upwards; None for an absolute encoder."""
    home: float
    """Position at the home in m or rad. The drive counts from its home: the sign of 607Ch differs
    between makers, so that it is 0."""
    homing_velocity: float
    """Speed to the switch in m/s or rad/s; back from it a fifth."""


class Cia402Drive(Axis):
    """An axis with one drive on the bus."""

    settings: DriveSettings

    def __init__(self, settings: DriveSettings, bus: DriveBus) -> None:
        node_id = settings.node_id
        home = None if settings.homing is None else settings.home
        super().__init__(settings, f"drive {node_id}", bus.watch, home)
        self._bus = bus
        self._home_count = round((home or 0.0) * settings.increments)
        self._client = PolledSdoClient(
            node_id,
            od.of_node(node_id),
            name=self.label,
            clock=bus.watch.clock,
            service=self.check,
            wait=bus.wait,
            timeout_s=_SDO_SHARE * bus.loss_s,
        )
        self._client.network = bus  # it raises AxisSilent if the interface fails
        self._heard_s = 0.0
        self._nmt_state = _OPERATIONAL
        self._homed = False
        self._supervised = False
        self._target = 0
        bus.subscribe(self._client.tx_cobid, self._client.on_response)
        bus.subscribe(od.COB_HEARTBEAT + node_id, self._on_heartbeat)

    # -- the interface of an axis ----------------------------------------------------------------

    def identify(self) -> str:
        """Return state and position in words; see `Axis`.

        Raises AxisNotOperational if it is stopped, AxisDuplicated for two drives.
        """
        self._supervised, self._nmt_state = False, _OPERATIONAL
        self._client.surplus = 0
        kind = self._read("Device type")
        if kind & 0xFFFF != od.PROFILE_402:
            raise errors.AxisMissing(
                f"{self.label} has device type {kind:08X}h, which is no CiA 402 drive: correct the "
                "node-ID"
            )
        state = self._state()
        words = f"{state}, position {self._read('Position actual value')} increments"
        if state == "FAULT":
            words += f", {od.error_code_text(self._read('Error code'))}"
        self._watch.pause(POLL_S)
        self.check()
        return words

    def prepare(self, *, reset: bool) -> None:
        """Set the drive up, enable it and find its home; the axis may move; see `Axis`.

        Raises MotionError if it is missing, stays at fault, refuses its set-up or does not find its
        home.
        """
        self._bus.drop_old()
        self._command("OPERATIONAL")  # a stopped drive answers no SDO
        self.identify()
        self._nmt_state = _BOOT_UP
        self._command("OPERATIONAL")  # a booting drive missed the first command
        self._write("Producer heartbeat time", round(1e3 * HEARTBEAT_S))
        self._until(
            lambda: self._nmt_state == _OPERATIONAL,
            "sends no heartbeat as operational: look for another CANopen master",
            errors.AxisNotOperational,
            _START_S,
        )
        if self._state() == "OPERATION ENABLED":
            # It may still move: a silent drive could not be stopped.
            self._write("Controlword", State402.CW_QUICK_STOP)
            braking_s = self.settings.velocity / self.settings.acceleration
            self._until(self.standing, "does not stop", timeout_s=_STATE_S + braking_s)
        self._set_up()
        if reset:
            self._reset_fault()
        self._supervised = True
        self._enable()
        here = self.settings.homing is HomingMethod.HERE
        if self.settings.homing is not None and not (here and self._homed):
            self._home(self.settings.homing)
        self._set_mode(OperationMode.PROFILED_POSITION)

    def clear_fault(self, *, reboot: bool) -> None:
        """Clear the fault of the drive, without a restart; see `Axis`."""
        self._command("OPERATIONAL")
        self.identify()
        self._reset_fault()

    def wake(self) -> None:
        """Check that the drive still answers, is enabled and has no fault."""
        self._bus.drop_old()
        self._heard_s = self._watch.clock.monotonic()
        self._client.surplus = 0
        self._supervised = True
        if self._state() == "QUICK STOP ACTIVE":
            self._enable()
        self._enabled_status()

    def go_to(self, position: float) -> None:
        """Begin to move; see `Axis`."""
        target = self.target(position)
        # The monitored node-ID, and its longest silence in ms (CiA 301, 1016h).
        host_lost_ms = round(1e3 * _HOST_LOST_FACTOR * self._bus.loss_s)
        self._write("Consumer heartbeat time.Host", _HOST_NODE << 16 | host_lost_ms)
        self._bus.beat()
        self._write("Target position", target - self._home_count)
        self._target = target
        self._write("Controlword", od.NEW_SET_POINT)
        self._until(lambda: bool(self._status() & Status.ACKNOWLEDGED), "takes no set-point")
        self._write("Controlword", State402.CW_OPERATION_ENABLED)
        self._until(lambda: not self._status() & Status.ACKNOWLEDGED, "keeps its set-point")

    def arrived(self) -> bool:
        """Return whether the target is reached: by the statusword and by the position.

        Raises MotionError if the drive is at fault, silent, restarted, or stopped by a limit
        switch.
        """
        status = self._enabled_status()
        window = self.settings.counts(self.settings.window)
        reached = bool(status & Status.TARGET_REACHED)
        return reached and abs(self.read_increments() - self._target) <= window

    def rest(self) -> None:
        """End the drive's supervision of the host's heartbeat."""
        self._write("Consumer heartbeat time.Host", 0)

    def read_increments(self) -> int:
        """Return the present position in increments (6064h)."""
        return self._read("Position actual value") + self._home_count

    def stop(self) -> None:
        """Send a quick stop without a wait; a silent drive may still receive it."""
        if self._nmt_state == _STOPPED:
            self._command("PRE-OPERATIONAL")  # else it receives no SDO
        self._bus.send_message(self._client.rx_cobid, _QUICK_STOP_REQUEST)

    def standing(self) -> bool:
        """Return whether the axis stands still after a stop.

        If it does, the drive's supervision of the host's heartbeat ends.
        """
        self._supervised = False
        slow = self.settings.counts(self.settings.velocity) * _STILL_SHARE
        still = abs(self._read("Velocity actual value")) <= slow
        stands = still and self._state() != "OPERATION ENABLED"
        if stands:
            self.rest()
        return stands

    def check(self) -> None:
        """Raise an error from heartbeat and answers since the last check."""
        self._bus.service()
        surplus = self._client.surplus
        if surplus >= _SURPLUS_ANSWERS:
            raise errors.AxisDuplicated(
                f"{self.label} sent {surplus} SDO answers more than there were requests: a second "
                "drive has the same node-ID, or another program uses it. Leave one of them on the "
                "bus"
            )
        if self._supervised and self._nmt_state == _BOOT_UP:
            raise errors.AxisRestarted(
                f"{self.label} has booted: its position is lost until it is homed again. Check its "
                "supply"
            )
        # A stopped drive answers no SDO.
        if self._nmt_state == _STOPPED or (self._supervised and self._nmt_state != _OPERATIONAL):
            state = NMT_STATES.get(self._nmt_state, "unknown").lower()
            raise errors.AxisNotOperational(
                f"{self.label} is in the NMT state {state}, it has to be operational: its host was "
                "silent, or another CANopen master has commanded it. Look for that master; the "
                "next motion makes the drive operational"
            )
        silent_s = self._watch.clock.monotonic() - self._heard_s
        if self._supervised and silent_s > self._bus.loss_s:
            raise errors.AxisSilent(
                f"no heartbeat from {self.label} for {silent_s:.3f} s, allowed are "
                f"{self._bus.loss_s:g} s; its position is unknown. Check its supply and CAN cable"
            )

    # -- parts -----------------------------------------------------------------------------------

    def _command(self, command: str) -> None:
        """Command an NMT state."""
        self._bus.send_message(od.COB_NMT, bytes((NMT_COMMANDS[command], self.settings.node_id)))

    def _set_up(self) -> None:
        settings, counts = self.settings, self.settings.counts
        low, high = settings.limits
        acceleration = counts(settings.acceleration)
        for name, value in (
            ("Software position limit.Min position limit", low - self._home_count),
            ("Software position limit.Max position limit", high - self._home_count),
            ("Following error window", counts(settings.lag)),
            ("Following error time out", _FOLLOWING_MS),
            ("Position window", counts(settings.window)),
            ("Position window time", _WINDOW_MS),
            ("Profile velocity", counts(settings.velocity)),
            ("Profile acceleration", acceleration),
            ("Profile deceleration", acceleration),
            ("Quick stop deceleration", 2 * acceleration),
            ("Quick stop option code", od.STAY_IN_QUICK_STOP),
            ("Abort connection option code", od.STOP_WHEN_HOST_IS_LOST),
            ("Consumer heartbeat time.Host", 0),
        ):
            self._write(name, value)
            if (answer := self._read(name)) != value:
                raise errors.AxisMissing(
                    f"{self.label} keeps {answer} in {self._client.label(name)} instead of "
                    f"{value}: correct the config or the drive's own limits"
                )

    def _enable(self) -> None:
        def enabled() -> bool:
            state = self._sound_state(self._status())
            if state in _NEXT:
                self._write("Controlword", _NEXT[state])
            return state == "OPERATION ENABLED"

        if self._state() == "QUICK STOP ACTIVE":
            # Transition 16 keeps the torque; it is optional (CiA 402-2).
            self._write("Controlword", State402.CW_OPERATION_ENABLED)
        failure = "is not enabled: check its power stage, enable input and safe torque off"
        self._until(enabled, failure, errors.AxisMissing)

    def _reset_fault(self) -> None:
        if self._state() not in _AT_FAULT:
            return
        fault = od.error_code_text(self._read("Error code"))
        self._write("Controlword", State402.CW_DISABLE_VOLTAGE)
        self._write("Controlword", State402.CW_SWITCH_ON_DISABLED)  # fault reset
        self._until(
            lambda: self._state() not in _AT_FAULT, f"stays at fault, {fault}: remedy its cause"
        )

    def _home(self, method: HomingMethod) -> None:
        settings, counts = self.settings, self.settings.counts
        if settings.increments < 0 and method is not HomingMethod.HERE:
            # An inverted drive has its positive switch at the lower end of the axis.
            method = HomingMethod(
                HomingMethod.NEGATIVE_SWITCH + HomingMethod.POSITIVE_SWITCH - method
            )
        fast = counts(settings.homing_velocity)
        self._set_mode(OperationMode.HOMING)
        self._write("Homing method", method)
        self._write("Home offset", 0)
        self._write("Homing speeds.Speed during search for switch", fast)
        slow = max(1, fast // _ZERO_SPEED_SHARE)
        self._write("Homing speeds.Speed during search for zero", slow)
        self._write("Homing acceleration", counts(settings.acceleration))
        self._write("Controlword", od.START_HOMING)
        # The longest travel: from one end to the other, and back from the switch.
        travel_s = 2.0 * (settings.high - settings.low) / settings.homing_velocity

        def attained() -> bool:
            status = self._status()
            if status & Status.MODE_ERROR:
                raise errors.HomingFailed(f"{self.label} reports a homing error: check its switch")
            self._check_enabled(status)
            return bool(status & Status.ACKNOWLEDGED and status & Status.TARGET_REACHED)

        failure = "has not found its home: check its switch"
        self._until(attained, failure, errors.HomingFailed, _STATE_S + travel_s)
        self._homed = True
        self._write("Controlword", State402.CW_OPERATION_ENABLED)

    def _set_mode(self, mode: int) -> None:
        self._write("Modes of operation", mode)
        self._until(
            lambda: self._read("Modes of operation display") == mode,
            f"does not take the mode {OperationMode.CODE2NAME[mode].lower()}",
        )

    def _enabled_status(self) -> int:
        """Return the statusword of a drive that is enabled and at no limit switch."""
        status = self._status()
        self._check_enabled(status)
        if status & Status.INTERNAL_LIMIT:
            raise errors.LimitSwitchReached(
                f"{self.label} is stopped by a limit switch at {self.read_increments()} increments"
                ": check home and limits; it is homed again"
            )
        return status

    def _check_enabled(self, status: int) -> None:
        state = self._sound_state(status)
        if state != "OPERATION ENABLED":
            restarted = state == "SWITCH ON DISABLED"
            raise (errors.AxisRestarted if restarted else errors.AxisFault)(
                f"{self.label} left OPERATION ENABLED for {state}: it has restarted, its host was "
                "silent, another master commands it, or its enable input or safe torque off is open"
            )

    def _until(
        self,
        condition: Callable[[], bool],
        failure: str,
        error: type[Exception] = errors.AxisFault,
        timeout_s: float = _STATE_S,
    ) -> None:
        end_s = self._watch.clock.monotonic() + timeout_s
        while not condition():
            if self._watch.clock.monotonic() > end_s:
                raise error(f"{self.label} {failure} (waited {timeout_s:g} s)")
            self._watch.pause(POLL_S)
            self.check()

    def _state(self) -> str:
        return od.state_of(self._status())

    def _sound_state(self, status: int) -> str:
        """Return the state of a statusword. Raises AxisFault for a drive at fault."""
        state = od.state_of(status)
        if state in _AT_FAULT:
            code = od.error_code_text(self._read("Error code"))
            raise errors.AxisFault(f"{self.label} is at fault, {code}: remedy the cause")
        return state

    def _status(self) -> int:
        return self._read("Statusword")

    def _read(self, name: str) -> int:
        with self._asking(name):
            return int(self._client[name].raw)

    def _write(self, name: str, value: int) -> None:
        with self._asking(name):
            self._client[name].raw = int(value)

    @contextmanager
    def _asking(self, name: str) -> Iterator[None]:
        """Convert the errors of a transfer."""
        self.check()
        try:
            yield
        except ObjectRefused as error:
            raise errors.AxisMissing(
                f"{self.label} refused {self._client.label(name)} ({error.__cause__}): the drive "
                "does not have what CiA 402 asks for, or its limits are narrower"
            ) from error
        except NodeMissing as error:
            if isinstance(error.__cause__, SdoNotAnswered):
                raise errors.AxisSilent(str(error)) from error
            raise errors.AxisAnswerWrong(
                f"{self.label} answers wrongly ({self._client.label(name)}; {error.__cause__}): "
                "the drive is another one than CiA 402 describes, or somebody else sends with its "
                "node-ID. Check drive, firmware and node-IDs"
            ) from error

    def _on_heartbeat(self, _cob_id: int, data: bytearray, _time_s: float) -> None:
        self._heard_s = self._watch.clock.monotonic()
        # Some drives send a boot-up without data.
        self._nmt_state = data[0] & _STATE_BITS if data else _BOOT_UP
        self._homed &= self._nmt_state != _BOOT_UP
