"""The firmware of a simulated servo: boot, torque, goals, bus watchdog, protections.

`simulator.servo` answers instructions with it; `simulator.motor` carries out what it commands.
"""

import math
from collections.abc import Mapping
from enum import Enum

from gripper.registers import (
    RAD_S_PER_VELOCITY_UNIT,
    WATCHDOG_TRIPPED_RAW,
    WATCHDOG_UNIT_S,
    ServoModel,
)
from simulator.control_table import ControlTable
from simulator.motor import OVERLOAD_BUDGET_S, DriveCommand, DriveMode
from simulator.servo_goals import goal_command, hold_command
from simulator.servo_plant import ServoPlant
from simulator.servo_position import ServoPosition
from simulator.servo_registers import ServoRegisters

REBOOT_S = 0.35
"""Time in s during which a rebooting servo does not hear or answer anything."""
_CAUSE_VOLTAGE, _CAUSE_HEAT, _CAUSE_OVERLOAD = 0x01, 0x04, 0x20


class WatchdogStop(Enum):
    """What the motor does when the bus watchdog trips; the e-Manual only says that it stops.

    HOLD keeps the present position within the present current limit. ZERO_CURRENT lets the winding
    go without current. KEEPS_TURNING is the fault of the 330 size: register 98 reads -1 and the
    motor goes on.
    """

    HOLD = "hold"
    ZERO_CURRENT = "zero_current"
    KEEPS_TURNING = "keeps_turning"


class ServoCore:
    """Registers of one servo and what they do.

    Parameters
    ----------
    servo_id
        Content of register 7.
    model, firmware
        Model and firmware version.
    plant
        The motor.
    settings
        Raw values of EEPROM items by register name, over the factory's.
    watchdog_stop
        What a tripped bus watchdog does to the motor.

    Attributes
    ----------
    registers, position
        The servo's registers and counts.
    injected_error
        Bits of Hardware Error Status that a fault knob forces.
    silent_until_s
        End of a reboot's blackout.
    """

    def __init__(
        self,
        servo_id: int,
        model: ServoModel,
        plant: ServoPlant,
        *,
        firmware: int,
        settings: Mapping[str, int] | None = None,
        watchdog_stop: WatchdogStop = WatchdogStop.HOLD,
    ) -> None:
        self.registers = ServoRegisters(model, firmware, {**(settings or {}), "id": servo_id})
        self.position = ServoPosition(self.registers, plant)
        self.plant = plant
        self.watchdog_stop = watchdog_stop
        self.injected_error = 0
        self.silent_until_s = -math.inf
        self._fed_s = 0.0
        self._watchdog_s = math.inf
        self._stopped = False
        self._booted_s = 0.0
        self.boot(0.0, blackout_s=0.0)

    @property
    def table(self) -> ControlTable:
        """The control table."""
        return self.registers.table

    @property
    def model(self) -> ServoModel:
        """The servo model."""
        return self.registers.model

    @property
    def firmware(self) -> int:
        """Firmware version."""
        return self.registers.firmware

    @property
    def torque_on(self) -> bool:
        """Whether Torque Enable is 1."""
        return self.table.data[64] != 0

    @property
    def watchdog_tripped(self) -> bool:
        """Whether Bus Watchdog reads -1."""
        return self.table.data[98] == WATCHDOG_TRIPPED_RAW & 0xFF

    @property
    def latched(self) -> bool:
        """Whether a hardware error keeps the torque off until a reboot."""
        return bool(self.table.data[70] & self.table.data[63])

    @property
    def moving(self) -> bool:
        """Whether the velocity is above Moving Threshold (register 24)."""
        threshold = self.registers.get("moving_threshold") * RAD_S_PER_VELOCITY_UNIT
        return abs(self.plant.sensed_velocity_rad_s) > threshold

    def boot(self, now_s: float, *, blackout_s: float = REBOOT_S) -> None:
        """Start the firmware anew: RAM to its defaults, one turn, torque as configured."""
        self.registers.load_ram()
        self.silent_until_s = now_s + blackout_s
        self._booted_s = now_s
        self._fed_s = now_s
        self._watchdog_s = math.inf
        self._stopped = False
        self.plant.load_excess_s = 0.0
        self.position.fold_turns()
        self.registers.put("goal_position", self.position.present_raw())
        startup = self.registers.get("startup_configuration")
        if startup & 2:
            self.registers.restore_ram()
        self.table.data[64] = startup & 1
        self.apply_goals()

    def restore_backup(self, now_s: float) -> bool:
        """Bring EEPROM and RAM back and boot; False when there is no backup."""
        if not self.registers.has_backup:
            return False
        self.registers.restore_eeprom()
        self.boot(now_s)
        self.registers.restore_ram()
        return True

    def refresh(self, now_s: float) -> None:
        """Bring registers 120 to 146 up to date."""
        following = self.torque_on and not self._stopped and self.table.data[11] in {3, 4, 5}
        self.position.refresh(now_s - self._booted_s, following=following)

    def goal_written(self) -> None:
        """Carry out new goals; a motor that the watchdog stopped follows goals again."""
        self._stopped = False
        if self.table.data[10] & 8 and not self.torque_on and not self.latched:
            self.set_torque(on=True)
            return
        self.apply_goals()

    def apply_goals(self) -> None:
        """Turn mode, goals, limits and gains into a command for the motor."""
        if self._stopped:
            return
        if self.torque_on:
            command = goal_command(self.registers, self.position, self.plant.reference_rad)
        else:
            command = DriveCommand()
        self.plant.drive(command)

    def change_mode(self) -> None:
        """Carry out the side effects of writing Operating Mode."""
        self.registers.change_mode()
        if self.table.data[11] == 3:
            self.position.fold_turns()

    def set_torque(self, *, on: bool) -> None:
        """Switch the torque; switching it on in mode 3 falls back to one turn."""
        if on and not self.torque_on and self.table.data[11] == 3:
            self.position.fold_turns()
        self.table.data[64] = 1 if on else 0
        self._stopped = self._stopped and on
        self.apply_goals()

    def set_watchdog(self, raw: int, now_s: float) -> None:
        """Arm, disarm or clear the bus watchdog; a stopped motor waits for the next goal."""
        self._watchdog_s = raw * WATCHDOG_UNIT_S if raw > 0 else math.inf
        self._fed_s = now_s

    def feed(self, now_s: float) -> None:
        """Note that an instruction packet was on the bus."""
        self._fed_s = now_s

    def supervise(self, now_s: float) -> None:
        """Let watchdog and protections act; call it at least once a motor step."""
        data = self.table.data
        if data[64] == 0:
            self._fed_s = now_s
        elif now_s - self._fed_s > self._watchdog_s:
            self._trip()
        plant = self.plant
        bits = self.injected_error
        if plant.temperature_c > data[31]:
            bits |= _CAUSE_HEAT
        if plant.load_excess_s > OVERLOAD_BUDGET_S:
            bits |= _CAUSE_OVERLOAD
        volts = plant.voltage_v * 10.0
        if volts > (data[32] | data[33] << 8) or volts < (data[34] | data[35] << 8):
            bits |= _CAUSE_VOLTAGE
        if bits and bits & ~data[70]:
            data[70] |= bits
            if self.latched and self.torque_on:
                self.set_torque(on=False)

    def _trip(self) -> None:
        self._watchdog_s = math.inf
        self.registers.put("bus_watchdog", WATCHDOG_TRIPPED_RAW)
        self.registers.put("profile_acceleration", 0)
        self.registers.put("profile_velocity", 0)
        if self.watchdog_stop is WatchdogStop.KEEPS_TURNING:
            return
        self._stopped = True
        if self.watchdog_stop is WatchdogStop.ZERO_CURRENT:
            self.plant.drive(DriveCommand(DriveMode.CURRENT))
        else:
            self.plant.drive(hold_command(self.registers, self.plant.sensed_rad))
