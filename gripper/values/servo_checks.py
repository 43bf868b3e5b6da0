"""Results of checks of servos: torque and errors, and registers against their requirements."""

from dataclasses import dataclass
from enum import IntFlag


class HardwareError(IntFlag):
    """Bits of Hardware Error Status (register 70) and Shutdown (register 63)."""

    INPUT_VOLTAGE = 1
    OVERHEATING = 4
    ENCODER = 8
    ELECTRICAL_SHOCK = 16
    OVERLOAD = 32


def hardware_errors_text(bits: int) -> str:
    """Return the names of the bits of Hardware Error Status (register 70), lowest bit first."""
    names = {int(bit): name for name, bit in HardwareError.__members__.items()}
    texts = (names.get(1 << n, f"undefined bit {n}") for n in range(8) if bits >> n & 1)
    return ", ".join(name.lower().replace("_", " ") for name in texts)


def overload_text(shutdown_raw: int) -> str:
    """Return what a servo does on overload, by its Shutdown (register 63)."""
    if shutdown_raw & HardwareError.OVERLOAD:
        return "an overload switches its torque off: a held part drops"
    return "an overload is only reported: the cell's limit of heat alone protects it"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoCondition:
    """Torque and errors of one servo, read separately from the others."""

    servo_id: int
    """The servo."""
    answers: bool = True
    """False if it did not answer; its torque is then unknown, and the rest False and 0."""
    answers_off: bool = False
    """True if it answered pings only: its Status Return Level (register 68) is 0."""
    torque_on: bool = False
    """Whether its torque is on."""
    error_bits: int = 0
    """Hardware Error Status (register 70)."""
    shut_down: bool = False
    """Whether one of these errors keeps the torque off until a reboot (register 63)."""
    strayed: str = ""
    """Why its position must not be used until a reboot, or empty."""

    @property
    def able(self) -> bool:
        """True when the servo can be moved, by switching its torque on where that is off."""
        return self.answers and not self.shut_down and not self.strayed

    def __str__(self) -> str:
        if self.answers_off:
            return (
                f"servo {self.servo_id} answers pings only: its Status Return Level (register 68) "
                f"is 0; a start or a release sets it to 2"
            )
        if not self.answers:
            return f"servo {self.servo_id} does not answer"
        torque = "its torque on" if self.torque_on else "no torque"
        errors = hardware_errors_text(self.error_bits)
        strayed = f", and where its finger is, is unknown: {self.strayed}" if self.strayed else ""
        return f"servo {self.servo_id} has {torque}" + (f" ({errors})" if errors else "") + strayed


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationRow:
    """Comparison of one register of a servo with its requirement."""

    servo_id: int
    """The servo."""
    item: str
    """Name of the register."""
    expected: str
    actual: str
    """As text, in raw units of the register."""
    ok: bool
    """True when they agree, or were made to agree."""
    corrected: bool = False
    """True when the register was rewritten to agree."""

    def __str__(self) -> str:
        return f"servo {self.servo_id} {self.item}: expected {self.expected}, found {self.actual}"


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationReport:
    """All comparisons of a start."""

    rows: tuple[VerificationRow, ...]
    """One for each servo and item."""

    @property
    def ok(self) -> bool:
        """True when every row agrees."""
        return all(row.ok for row in self.rows)

    @property
    def failed(self) -> tuple[VerificationRow, ...]:
        """The rows that do not agree."""
        return tuple(row for row in self.rows if not row.ok)
