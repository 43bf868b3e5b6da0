"""The tables of the Modbus registers and commands, made from those of all interfaces."""

from cell.interfaces.modbus.registers import COMMANDS, N_TEXT, VALUES, Value


def registers_page() -> str:
    """Return one row for each value and its input registers."""
    rows = {
        value.register: f"| {_registers(value)} | {value.text}"
        + (f"; unit {value.unit:g}" if value.kind is float and value.unit != 1.0 else "")
        + " |"
        for value in VALUES
    }
    return "\n".join(("| register | value |", "| --- | --- |", *(rows[n] for n in sorted(rows))))


def _registers(value: Value) -> str:
    """Return the registers of a value as text."""
    last = value.register + N_TEXT - 1
    return f"{value.register} to {last}" if value.kind is str else str(value.register)


def commands_page() -> str:
    """Return one row for each command that starts a job."""
    rows = ["| command | | what it takes |", "| --- | --- | --- |"]
    for command in COMMANDS:
        numbers = ", ".join(map(str, command.numbers))
        rows.append(f"| {numbers} | {command.text} | {', '.join(command.fields)} |")
    return "\n".join(rows)
