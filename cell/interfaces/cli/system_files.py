"""System files of a cell that runs as a service: udev rules, its user, the systemd unit."""

import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from stat import S_IROTH, S_IXOTH

from cell.commissioning.ports import udev_rule, usb_identity
from cell.config.model import CellConfig

NAME = "tactile-cell"
"""Name of the service, its user and its folder in /var/lib."""
STATE_FOLDER = Path("/var/lib", NAME)
"""Working folder of the service; it writes here."""
RULES_FILE = Path("/etc/udev/rules.d/99-tactile-cell.rules")
USER_FILE = Path("/etc/sysusers.d/tactile-cell.conf")
UNIT_FILE = Path("/etc/systemd/system/tactile-cell.service")
"""Files that are installed: udev rules, user, systemd unit."""
AFTER_WRITING = (
    "systemd-sysusers",
    "udevadm control --reload && udevadm trigger",
    "systemctl daemon-reload && systemctl enable --now tactile-cell",
)
"""Commands that activate the files."""
_CHIPS = "0403|10c4|1a86"
"""USB vendors whose adapters brltty mistakes for braille displays: FTDI, Silicon Labs, WCH."""
_UNIT = """\
# A cell that names parts by touch. Made by `tactile-cell service install`.
[Unit]
Description=tactile-cell, the robot cell that names parts by touch
Wants=network-online.target
After=network-online.target
# It always starts again, without a limit. A supervisor looks at the fault.
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
{prepare}ExecStart={command}
WorkingDirectory={state}
StateDirectory={name}
User={name}
SupplementaryGroups=dialout

# Ready when clients can command. Before that, the first start of the built-in cell teaches objects.
TimeoutStartSec=180
# Fed only while the service works, see /healthz. The signal ends the cell; the grip is kept.
WatchdogSec=30
WatchdogSignal=SIGTERM

# The force loop is a second process. Before it ends it freezes the grip and disarms the bus
# watchdog of the servos. No process may be killed before that: "control-group" sends SIGTERM to
# both, and SIGKILL after TimeoutStopSec. "mixed" would send SIGKILL to the force loop as soon as
# the main process ends.
KillMode=control-group
KillSignal=SIGTERM
TimeoutStopSec=45
OOMPolicy=continue
OOMScoreAdjust=-500
# A start with a part in the grip moves nothing and waits for `clear` and `release`.
Restart=on-failure
RestartSec=2
# 2: wrong use or a wrong config, which another start does not correct.
RestartPreventExitStatus=2

# The force loop requests SCHED_FIFO and locked memory.
LimitRTPRIO=99
LimitMEMLOCK=infinity

# The line with all ports is for programs; people read the journal.
StandardOutput=null
StandardError=journal
SyslogIdentifier={name}

NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
{writable}
[Install]
WantedBy=multi-user.target
"""


@dataclass(frozen=True, slots=True)
class SystemFile:
    """A file of the system that `service install` prints or writes."""

    path: Path
    text: str


def system_files(
    config: CellConfig, config_file: Path | None, options: tuple[str, ...] = ()
) -> tuple[SystemFile, ...]:
    """Return rules, user and unit of a cell.

    Parameters
    ----------
    config, config_file
        The cell, and its file; None: the built-in simulated cell.
    options
        Further options of `serve`.
    """
    user = f'u {NAME} - "tactile-cell" {STATE_FOLDER}\nm {NAME} dialout\n'
    return (
        SystemFile(RULES_FILE, "\n".join(_rules(config)) + "\n"),
        SystemFile(USER_FILE, user),
        SystemFile(UNIT_FILE, _unit(config, config_file, options)),
    )


# -- udev --------------------------------------------------------------------------------------


def _rules(config: CellConfig) -> Iterator[str]:
    yield "# Serial adapters of a tactile cell. Made by `tactile-cell service install`."
    yield "# The latency timer of FTDI adapters: 16 ms by default, too long for the force loop."
    yield udev_rule().partition(" in ")[0]
    yield "# brltty mistakes these adapters for braille displays and takes their ports."
    yield (
        f'SUBSYSTEM=="usb", ENV{{BRLTTY_BRAILLE_DRIVER}}=="?*", ATTR{{idVendor}}=="{_CHIPS}", '
        'ENV{BRLTTY_BRAILLE_DRIVER}="", ENV{SYSTEMD_WANTS}=""'
    )
    for role, key, port in config.serial_ports:
        identity = usb_identity(port)
        if identity is None:
            yield f"# {key}: {port} is no connected USB adapter; it gets no name."
        else:
            match = ", ".join(f'ENV{{{name}}}=="{value}"' for name, value in identity.items())
            by = "in this USB socket" if "DEVPATH" in identity else "in any USB socket"
            yield f"# {key}: this adapter {by} is /dev/{NAME}/{role}, and no modem."
            yield f'SUBSYSTEM=="tty", {match}, SYMLINK+="{NAME}/{role}"'
            yield (
                'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", '
                f'ATTR{{idVendor}}=="{identity["ID_VENDOR_ID"]}", '
                f'ATTR{{idProduct}}=="{identity["ID_MODEL_ID"]}", ENV{{ID_MM_DEVICE_IGNORE}}="1"'
            )


# -- systemd -----------------------------------------------------------------------------------


def _unit(config: CellConfig, config_file: Path | None, options: tuple[str, ...]) -> str:
    folder = Path(config.recording.directory)
    command = [*program(), "serve", *options, "--out", str(folder)]
    if config_file is not None:
        command += ["--config", str(config_file.resolve())]
    prepare = "".join(f"ExecStartPre=-+{shlex.join(one)}\n" for one in _can_commands(config))
    writable = f"ReadWritePaths=-{folder}\n" if folder.is_absolute() else ""
    return _UNIT.format(
        command=" ".join(map(_quoted, command)),
        name=NAME,
        prepare=prepare,
        state=STATE_FOLDER,
        writable=writable,
    )


def program() -> list[str]:
    """Return the command that starts this program, with whole paths."""
    beside = Path(sys.executable).with_name(NAME)
    return (
        [str(beside)]
        if beside.exists()
        else [
            sys.executable,
            "-c",
            "from cell.interfaces.cli import main; main()",
        ]
    )


def closed_to_others(path: Path) -> Path | None:
    """Return the first folder, or the file, that other users may not read; None: all readable."""
    path = path.resolve()
    folders = reversed(path.parents)
    closed = (one for one in folders if one.exists() and not one.stat().st_mode & S_IXOTH)
    unread = path.is_file() and not path.stat().st_mode & S_IROTH
    return next(closed, path if unread else None)


def _can_commands(config: CellConfig) -> Iterator[list[str]]:
    """Yield the commands that bring SocketCAN interfaces up, as root; they may be up already."""
    buses = [can for _, _, can in config.can_buses if can.interface == "socketcan"]
    for channel, bitrate in {can.channel: can.bitrate for can in buses}.items():
        link = [shutil.which("ip") or "/usr/sbin/ip", "link", "set", channel]
        yield [*link, "type", "can", "bitrate", str(bitrate), "restart-ms", "100"]
        yield [*link, "up"]


def _quoted(word: str) -> str:
    """Return a word of a command quoted for systemd, which then reads %, $ and blanks as text."""
    word = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{word}"' if any(sign in " \\\"';" for sign in word) else word
