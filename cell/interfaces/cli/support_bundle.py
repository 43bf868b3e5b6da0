"""The support bundle: files for remote support, without secrets."""

import platform
import re
import shutil
import ssl
import subprocess
from contextlib import suppress
from importlib.metadata import distributions
from ipaddress import ip_address
from pathlib import Path
from typing import BinaryIO
from urllib.request import Request, urlopen
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

from cell.config.file import config_text
from cell.config.model import CellConfig
from cell.config.serve import ServeConfig
from cell.errors import CellError, ConfigError
from cell.files import json_bytes, write_atomically
from cell.interfaces.access import read_secret, view_token
from cell.interfaces.cli.system_files import NAME

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
    packages = sorted((one.name, one.version) for one in distributions())
    machine = {"python": platform.python_version(), "system": platform.platform()}
    texts = {
        "config.yaml": config_text(public, comments=False),
        "versions.json": json_bytes(machine | {"packages": dict(packages)}).decode(),
        "health.txt": _asked(config.serve, "/healthz"),
        "state.txt": _asked(config.serve, "/api/state"),
        "journal.txt": _journal(),
    }
    recordings = Path(config.recording.directory).glob("*/*.mcap")
    *_, newest = [None, *sorted(recordings, key=lambda one: one.stat().st_mtime)]
    packed = newest is not None and newest.stat().st_size <= RECORDING_BYTES
    if newest is not None and not packed:
        texts["recording.txt"] = f"{newest}: left out, it has more than {RECORDING_BYTES} bytes\n"
    secrets = _secrets(config.serve)

    def write(file: BinaryIO) -> None:
        with ZipFile(file, "w", ZIP_DEFLATED) as archive:
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
    found = []
    for name in filter(None, (serve.token_file, serve.secret_file)):
        with suppress(ConfigError, OSError):
            secret = read_secret(name)
            found += [secret, view_token(secret)]
    return found


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
        with urlopen(request, timeout=_PATIENCE_S, context=context) as answer:
            return str(answer.read().decode())
    except (OSError, ConfigError) as error:
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
