"""`service`: files of an installed cell: system files, a bundle for support."""

import os
import platform
import re
import shlex
import shutil
import ssl
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from http.client import HTTPException
from importlib.metadata import distributions
from ipaddress import ip_address
from pathlib import Path
from stat import S_IROTH, S_IWOTH, S_IXOTH
from typing import Annotated, BinaryIO
from urllib.request import HTTPSHandler, ProxyHandler, Request, build_opener
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import typer

from cell.commissioning.ports import udev_rule, usb_identity
from cell.config.file import config_text
from cell.config.model import CellConfig
from cell.config.serve import ALL_CLOSED, ServeConfig
from cell.errors import CellError, ConfigError
from cell.files import json_bytes, write_atomically, write_text
from cell.interfaces.access import read_secret, view_token
from cell.interfaces.cli import options
from cell.interfaces.cli.session import cell_config, pads_of
from cell.interfaces.cli.terminal import ask, print_line, print_note
from cell.learning.model import load_model

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
    "udevadm control --reload && udevadm trigger --action=add",
    "systemctl daemon-reload && systemctl enable tactile-cell && systemctl restart tactile-cell",
)
"""Commands that activate the files."""
_CHIPS = "0403|10c4|1a86"
"""USB vendors whose adapters brltty mistakes for braille displays: FTDI, Silicon Labs, WCH."""
_FREE_PORTS = 1024
"""First port that a program opens without a privilege."""
_UNIT = Path(__file__).with_name("tactile-cell.service")
"""Template of the unit; `_unit` fills in what depends on the cell."""


def system_files(
    config: CellConfig, config_file: Path | None, options: tuple[str, ...] = ()
) -> dict[Path, str]:
    """Return the text of rules, user and unit of a cell, by their files.

    Parameters
    ----------
    config, config_file
        The cell, and its file; None: the built-in simulated cell.
    options
        Further options of `serve`.
    """
    user = f'u {NAME} - "tactile-cell" {STATE_FOLDER}\nm {NAME} dialout\n'
    return {
        RULES_FILE: "\n".join(_rules(config)) + "\n",
        USER_FILE: user,
        UNIT_FILE: _unit(config, config_file, options),
    }


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
    prepare = "".join(f"ExecStartPre=-+{shlex.join(words)}\n" for words in _can_commands(config))
    further = f"ReadWritePaths={_quoted(f'-{folder}')}\n" if folder.is_absolute() else ""
    if any(port < _FREE_PORTS for port in config.serve.ports):
        further += "AmbientCapabilities=CAP_NET_BIND_SERVICE\n"
    return _UNIT.read_text("utf-8").format(
        command=" ".join(map(_quoted, command)).replace("$", "$$"),
        name=NAME,
        prepare=prepare,
        state=STATE_FOLDER,
        further=further,
    )


def program() -> list[str]:
    """Return the command that starts this program, with whole paths.

    A link to the active version stays a link.
    """
    called = Path(sys.argv[0]).absolute()
    installed = called if called.name == NAME else Path(sys.executable).with_name(NAME)
    if installed.exists():
        return [str(installed)]
    return [sys.executable, "-c", "from cell.interfaces.cli import main; main()"]


def closed_to_service(path: Path) -> Path | None:
    """Return the first folder, or the file, that the service's user may not read; None: it may."""
    path = path.resolve()
    for folder in reversed(path.parents):
        if folder.exists() and not service_may(folder, S_IXOTH):
            return folder
    return path if path.is_file() and not service_may(path, S_IROTH) else None


def service_may(path: Path, others: int) -> bool:
    """Return whether the service's user has a permission, given as that of others."""
    for shift, name_of in ((6, path.owner), (3, path.group)):
        with suppress(KeyError):  # a number without a name on this machine
            if name_of() == NAME:
                return bool(path.stat().st_mode & others << shift)
    return bool(path.stat().st_mode & others)


def _can_commands(config: CellConfig) -> Iterator[list[str]]:
    """Yield the commands that bring SocketCAN interfaces up, as root; they may be up already."""
    buses = [can for _, _, can in config.can_buses if can.interface == "socketcan"]
    for channel, bitrate in {can.channel: can.bitrate for can in buses}.items():
        link = [shutil.which("ip") or "/usr/sbin/ip", "link", "set", channel]
        yield [*link, "type", "can", "bitrate", str(bitrate), "restart-ms", "100"]
        yield [*link, "up"]


def _quoted(word: str) -> str:
    """Return a word quoted for systemd, which then reads % and blanks as text."""
    word = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{word}"' if any(sign in " \\\"';" for sign in word) else word


REMOVED = "removed"
"""Text that replaces a secret."""
_SECRET_KEYS = ("token_file", "secret_file", "tls_key")
"""Keys of ``serve`` whose values are removed."""
_TOKEN_IN_TEXT = re.compile(r"""(token["']?[=:]\s*["']?|bearer\s+)[\w.~+/=-]+""", re.IGNORECASE)
"""A token in an address, a header or JSON."""
RECORDING_BYTES = 50_000_000
"""Largest size in bytes of the newest recording; a larger one is left out."""
_LINES = 2000
"""Number of newest lines of the journal."""
_PATIENCE_S = 5.0
"""Longest wait in s for the service, and for the journal."""


def write_bundle(path: Path, config: CellConfig) -> list[str]:
    """Write the bundle, a ZIP archive, and return the names of its files.

    Raises CellError if it cannot be written.
    """
    hidden = {key: REMOVED for key in _SECRET_KEYS if getattr(config.serve, key)}
    public = config.model_copy(update={"serve": config.serve.model_copy(update=hidden)})
    packages = sorted((package.name, package.version) for package in distributions())
    machine = {"python": platform.python_version(), "system": platform.platform()}
    texts = {
        "config.yaml": config_text(public, comments=False),
        "versions.json": json_bytes(machine | {"packages": dict(packages)}).decode(),
        "health.txt": _asked(config.serve, "/healthz"),
        "state.txt": _asked(config.serve, "/api/state"),
        "journal.txt": _journal(),
    }
    recordings = Path(config.recording.directory).glob("*/*.mcap")
    *_, newest = [None, *sorted(recordings, key=lambda path: path.stat().st_mtime)]
    packed = newest is not None and os.access(newest, os.R_OK)
    if newest is not None and not (packed and newest.stat().st_size <= RECORDING_BYTES):
        cause = (
            f"it has more than {RECORDING_BYTES} bytes" if packed else "no permission to read it"
        )
        texts["recording.txt"], packed = f"{newest}: left out, {cause}\n", False
    secrets = _secrets(config.serve)

    def write(file: BinaryIO) -> None:
        with ZipFile(file, "w", ZIP_DEFLATED, strict_timestamps=False) as archive:
            for name, text in texts.items():
                archive.writestr(name, _without(secrets, text))
            if newest is not None and packed:
                archive.write(newest, "recording.mcap", ZIP_STORED)

    write_atomically(path, write, error=CellError, what="support bundle")
    return [*texts, *(["recording.mcap"] if packed else [])]


def _without(secrets: list[str], text: str) -> str:
    """Return a text without known secrets, and without anything in the form of a token."""
    for secret in secrets:
        text = text.replace(secret, REMOVED)
    return _TOKEN_IN_TEXT.sub(rf"\g<1>{REMOVED}", text)


def _secrets(serve: ServeConfig) -> list[str]:
    """Return the secrets of a config, except for files that this user may not read."""
    secrets = []
    for name in filter(None, (serve.token_file, serve.secret_file)):
        with suppress(ConfigError, OSError):
            secret = read_secret(name)
            secrets += [secret, view_token(secret)]
    return secrets


def _asked(serve: ServeConfig, path: str) -> str:
    """Return the answer of the running service, or the reason why there is none."""
    if not serve.http_port:
        return "serve.http_port is not set: the service was not asked\n"
    host = "localhost" if ip_address(serve.listen).is_unspecified else serve.listen
    scheme, context = "http", None
    try:
        if serve.tls_certificate:
            # The certificate belongs to the cell and names its host, not this address.
            scheme, context = "https", ssl.create_default_context(cafile=serve.tls_certificate)
            context.check_hostname = False
        token = read_secret(serve.token_file) if serve.token_file else ""
        request = Request(
            f"{scheme}://{f'[{host}]' if ':' in host else host}:{serve.http_port}{path}",
            headers={"Authorization": f"Bearer {token}"},
        )
        # The token goes to the service alone, to no proxy of the environment.
        direct = build_opener(ProxyHandler({}), HTTPSHandler(context=context))
        with direct.open(request, timeout=_PATIENCE_S) as answer:
            return str(answer.read().decode())
    except (OSError, ValueError, HTTPException, ConfigError) as error:
        return f"the service did not answer: {error}\n"


def _journal() -> str:
    """Return the newest lines of the service's journal, or the reason why there are none."""
    if shutil.which("journalctl") is None:
        return "this machine has no journalctl\n"
    command = ["journalctl", "-u", NAME, "-n", str(_LINES), "--no-pager", "-o", "short-iso"]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_PATIENCE_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the journal cannot be read: {error}\n"
    return (done.stdout + done.stderr).decode(errors="replace")


def install(
    config: options.Config = None,
    model: options.Model = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Write the files; asks before each file.")
    ] = False,
    root: Annotated[Path, typer.Option("--root", help="Folder to use as /.", hidden=True)] = Path(
        "/"
    ),
) -> None:
    """Print udev rules, system user and systemd unit. Nothing is written without --apply.

    The service is `tactile-cell serve` with this config and model, and saves to it what is taught.
    It starts with the machine and starts again after a crash; a held part stays held.
    """
    served_with: tuple[str, ...] = ()
    checked = cell_config(config)
    if model is not None:
        load_model(model, pads_of(checked))
        served_with = "--model", str(model.resolve()), "--save", str(model.resolve())
    files = system_files(checked, config, served_with)
    changed = False
    if config is not None and not checked.serve.ports:
        print_note(ALL_CLOSED)
    for note in _notes(checked, (Path(program()[0]), config, model)):
        print_note(note)
    for file, text in files.items():
        path = root / file.relative_to("/")
        if apply:
            changed |= _write(path, text)
        else:
            print_line(f"# {path}\n{text}")
    if not apply:
        print_line("# nothing was written; add --apply to write these files")
    elif changed:
        print_line("now, as root:")
        for command in AFTER_WRITING:
            print_line(f"  {command}")


def _notes(config: CellConfig, files: Iterable[Path | None]) -> Iterator[str]:
    """Yield what the service's user cannot read or write: of these files, and of the config."""
    keys = (*_SECRET_KEYS, "tls_certificate")
    named = filter(None, (getattr(config.serve, key) for key in keys))
    secrets = {STATE_FOLDER / name for name in named}
    for path in filter(None, (*files, *sorted(secrets))):
        if (closed := closed_to_service(path)) is not None:
            advice = f"move it, for example to {STATE_FOLDER} or /opt, or permit it: chmod o+rX"
            if path in secrets:
                advice = f"give it to its group alone: chgrp {NAME} {closed} && chmod g+rX {closed}"
            yield f"{path}: the user {NAME} cannot read {closed}; {advice}"
        elif path in secrets and not path.exists():
            yield f"{path} is missing: the service reads it there"
    if config.positioner.kind == "operator":
        yield "positioner.kind is operator, and a service has no terminal: choose callback or axes"
    folder = Path(config.recording.directory)
    if folder.is_absolute() and not (os.path.isdir(folder) and service_may(folder, S_IWOTH)):
        made = f"install -d -o {NAME} -g {NAME} {shlex.quote(str(folder))}"
        yield f"the user {NAME} cannot write {folder} (recording.directory): {made}"


def _write(path: Path, text: str) -> bool:
    """Write a file if the person agrees; return whether it has changed."""
    before = path.read_text("utf-8", errors="replace") if path.exists() else None
    if before == text:
        print_line(f"{path}: already up to date")
        return False
    print_line(text)
    if not _agreed(f"{'overwrite' if before else 'write'} {path}?"):
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text, error=CellError, what="system file")
    path.chmod(0o644)
    return True


def _agreed(question: str) -> bool:
    """Ask a question at the terminal; the end of the input means no."""
    try:
        return ask(f"{question} y or n: ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def support(
    file: Annotated[Path, typer.Argument(help="Bundle to write (.zip).")],
    config: options.Config = None,
) -> None:
    """Pack config, versions, health, state, journal and the last recording for support.

    Tokens and secrets are removed. The service may run meanwhile. Check the bundle before you send
    it: it contains names of objects and machines.
    """
    names = write_bundle(file, cell_config(config))
    print_line(f"{file}: {', '.join(names)}")
