"""The registers of one simulated servo by name, with its factory values and its backup."""

from collections.abc import Mapping

from gripper.registers import REGISTERS, ServoModel
from simulator.control_table import ControlTable, in_range, is_x330
from simulator.errors import SimulatorSettingsError

EEPROM_END = 64
RAM_END = 168
"""First byte after the RAM items that a boot resets; indirect addresses begin there."""
GAINS = (
    "velocity_i_gain",
    "velocity_p_gain",
    "position_d_gain",
    "position_i_gain",
    "position_p_gain",
    "feedforward_2nd_gain",
    "feedforward_1st_gain",
)
_BACKED_UP_RAM = ((65, 69), (76, 92), (100, 116))


class ServoRegisters:
    """Control table of one servo with access by name.

    Parameters
    ----------
    model, firmware
        Model and firmware version.
    settings
        Raw values of EEPROM items by register name, over the factory's; SimulatorSettingsError for
        an unknown name or a value out of range.

    Attributes
    ----------
    table
        The control table.
    """

    __slots__ = ("_backup", "_factory", "firmware", "model", "table")

    def __init__(self, model: ServoModel, firmware: int, settings: Mapping[str, int]) -> None:
        self.model = model
        self.firmware = firmware
        self.table = ControlTable(model, firmware)
        self._factory = {
            **model.factory_defaults,
            "firmware_version": firmware,
            **({"pwm_slope": 140} if is_x330(model) else {}),
        }
        self._backup: bytes | None = None
        self.load_factory()
        for name, value in settings.items():
            self.configure(name, value)

    def configure(self, name: str, value: int) -> None:
        """Set an EEPROM item; SimulatorSettingsError for another item or a value out of range."""
        register = REGISTERS.get(name)
        if register is None or not register.eeprom:
            raise SimulatorSettingsError(f"{name!r} is not an EEPROM item of the control table")
        plan = self.table.plan(register.address, register.size)
        if not isinstance(plan, tuple) or not in_range(plan[0], value):
            raise SimulatorSettingsError(f"{name} = {value} is outside the range of the item")
        self.table.set(register.address, register.size, value)

    def get(self, name: str) -> int:
        """Return the raw value of an item by its name."""
        register = REGISTERS[name]
        return self.table.get(register.address, register.size, signed=register.signed)

    def put(self, name: str, value: int) -> None:
        """Set an item by its name, without access rules or side effects."""
        register = REGISTERS[name]
        self.table.set(register.address, register.size, value)

    def load_factory(self, *, keep: tuple[str, ...] = ()) -> None:
        """Set the EEPROM to the factory's values, except the items named in ``keep``."""
        kept = {name: self.get(name) for name in keep}
        self.table.data[0:EEPROM_END] = bytes(EEPROM_END)
        for item in self.table.items:
            if item.address < EEPROM_END:
                value = kept.get(item.name, self._factory.get(item.name, 0))
                self.table.set(item.address, item.size, value)

    def load_gains(self) -> None:
        """Set the gains to the defaults of the model."""
        for name in GAINS:
            self.put(name, self._factory.get(name, 0))

    def load_ram(self) -> None:
        """Set the RAM to its values after a boot."""
        self.table.data[EEPROM_END:RAM_END] = bytes(RAM_END - EEPROM_END)
        self.put("status_return_level", self._factory["status_return_level"])
        self.put("goal_pwm", self.get("pwm_limit"))
        self.put("goal_current", self.get("current_limit"))
        self.put("backup_ready", int(self._backup is not None))
        self.load_gains()

    def change_mode(self) -> None:
        """Carry out what writing Operating Mode does to other registers."""
        self.load_gains()
        self.put("profile_acceleration", 0)
        self.put("profile_velocity", 0)
        if self.table.data[11] == 5:
            self.put("pwm_limit", self._factory["pwm_limit"])
        self.put("goal_pwm", self.get("pwm_limit"))
        self.put("goal_current", self.get("current_limit"))

    @property
    def has_backup(self) -> bool:
        """Whether Control Table Backup has been carried out."""
        return self._backup is not None

    def store_backup(self) -> None:
        """Keep a copy of EEPROM and RAM (Control Table Backup)."""
        self._backup = bytes(self.table.data)
        self.put("backup_ready", 1)

    def restore_eeprom(self) -> None:
        """Bring the EEPROM of the backup back; without one nothing changes."""
        if self._backup is not None:
            self.table.data[7:EEPROM_END] = self._backup[7:EEPROM_END]

    def restore_ram(self) -> None:
        """Bring gains, goals and profile of the backup back; without one nothing changes."""
        if self._backup is not None:
            for start, end in _BACKED_UP_RAM:
                self.table.data[start:end] = self._backup[start:end]
