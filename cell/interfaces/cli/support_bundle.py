"""The support bundle: files for remote support, without secrets."""

import platform
import re
import shutil
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from importlib.metadata import distributions
from ipaddress import ip_address
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

from pydantic import BaseModel

from cell.config.file import config_text
from cell.config.model import CellConfig
from cell.config.serve import ServeConfig
from cell.errors import CellError, ConfigError
from cell.files import json_bytes, write_atomically
from cell.interfaces.access import read_secret, view_token
from cell.interfaces.cli.system_files import NAME
from cell.recording import schema
from cell.recording.reader import RecordedMessages

REMOVED = "removed"
"""Text that replaces a secret."""
_SECRET_KEY = re.compile(r"token|secret|password|tls_key", re.IGNORECASE)
"""Keys whose values are removed; names of files are removed too."""
_TOKEN_IN_TEXT = re.compile(r"""(token["']?[=:]\s*["']?|bearer\s+)[\w.~+/=-]+""", re.IGNORECASE)
"""A token in an address, a header or JSON."""
_RECORDINGS = 5
"""Number of newest recordings whose faults are listed."""
_FAULTS = 50
"""Number of newest faults of each recording."""
_LINES = 2000
"""Number of newest lines of the journal."""
_PATIENCE_S = 5.0
"""Longest wait in s for the service, and for the journal."""


@dataclass(frozen=True, slots=True)
class Member:
    """A file of the bundle, with a note for people."""

    name: str
    content: bytes | Path
    """Bytes, or the path of a file to copy."""
    note: str


def write_bundle(
    path: Path, config: CellConfig, recordings: Path, limit_bytes: int
) -> tuple[Member, ...]:
    """Write the bundle and return its members.

    Raises CellError if it cannot be written.

    Parameters
    ----------
    path
        The file, a ZIP archive.
    config
        The cell.
    recordings
        Folder of the recordings.
    limit_bytes
        Largest size in bytes of the newest recording; a larger recording is left out.
    """
    members = tuple(_members(config, recordings, limit_bytes))
    secrets = _secrets(config.serve)

    def write(file: BinaryIO) -> None:
        with ZipFile(file, "w", ZIP_DEFLATED) as archive:
            for member in members:
                if isinstance(member.content, Path):
                    archive.write(member.content, member.name, ZIP_STORED)
                else:
                    archive.writestr(member.name, without_secrets(member.content, secrets))

    write_atomically(path, write, error=CellError, what="support bundle")
    return members


def without_secrets(content: bytes, secrets: tuple[str, ...]) -> bytes:
    """Return a text without known secrets, and without anything in the form of a token."""
    text = content.decode(errors="replace")
    for secret in secrets:
        text = text.replace(secret, REMOVED)
    return _TOKEN_IN_TEXT.sub(rf"\g<1>{REMOVED}", text).encode()


def without_secret_keys(section: BaseModel) -> BaseModel:
    """Return a config without the values of keys that name secrets."""
    changes: dict[str, Any] = {}
    for key, value in section:
        if isinstance(value, BaseModel):
            changes[key] = without_secret_keys(value)
        elif value and _SECRET_KEY.search(key):
            changes[key] = REMOVED
    return section.model_copy(update=changes)


def _secrets(serve: ServeConfig) -> tuple[str, ...]:
    """Return the secrets of a config, except for files that this user may not read."""
    found = []
    for name in filter(None, (serve.token_file, serve.secret_file)):
        with suppress(ConfigError, OSError):
            secret = read_secret(name)
            found += [secret, view_token(secret)]
    return tuple(found)


def _members(config: CellConfig, recordings: Path, limit_bytes: int) -> Iterator[Member]:
    public = without_secret_keys(config)
    assert isinstance(public, CellConfig)
    yield Member("config.yaml", config_text(public, comments=False).encode(), "without secrets")
    yield Member("versions.json", json_bytes(_versions()), "of this machine and its packages")
    for name, path in (("health", "/healthz"), ("state", "/api/state"), ("metrics", "/metrics")):
        answer = _asked(config.serve, path)
        yield Member(f"{name}.txt", answer, f"{path} of the service")
    yield Member("journal.txt", _journal(), f"newest {_LINES} lines of the service")
    found = sorted(recordings.glob("*/*.mcap"), key=lambda one: one.stat().st_mtime)
    faults = {str(one): _faults(one) for one in found[-_RECORDINGS:]}
    yield Member("faults.json", json_bytes(faults), f"of the newest {len(faults)} recordings")
    if found:
        newest, size = found[-1], found[-1].stat().st_size
        if size <= limit_bytes:
            yield Member("recording.mcap", newest, str(newest))
        else:
            text = f"{newest}: left out, {size} bytes exceed the limit of {limit_bytes}\n"
            yield Member("recording.txt", text.encode(), text.strip())


def _versions() -> dict[str, Any]:
    return {
        "python": platform.python_version(),
        "system": platform.platform(),
        "packages": dict(sorted((one.name, one.version) for one in distributions())),
    }


def _asked(serve: ServeConfig, path: str) -> bytes:
    """Return the answer of the running service, or the reason why there is none."""
    if not serve.http_port:
        return b"serve.http_port is not set: the service was not asked\n"
    any_address = ip_address(serve.listen).is_unspecified
    host = "localhost" if any_address else serve.listen
    link = HTTPConnection(host, serve.http_port, timeout=_PATIENCE_S)
    try:
        if serve.tls_certificate:
            # The certificate belongs to the cell and names its host, not this address.
            context = ssl.create_default_context(cafile=serve.tls_certificate)
            context.check_hostname = False
            link = HTTPSConnection(host, serve.http_port, timeout=_PATIENCE_S, context=context)
        token = read_secret(serve.token_file) if serve.token_file else ""
        link.request("GET", path, headers={"Authorization": f"Bearer {token}"})
        answer = link.getresponse()
        return f"{answer.status}\n".encode() + answer.read()
    except (OSError, HTTPException, ConfigError) as error:
        return f"the service did not answer: {error}\n".encode()
    finally:
        link.close()


def _journal() -> bytes:
    """Return the newest lines of the service's journal, or the reason why there are none."""
    if shutil.which("journalctl") is None:
        return b"this machine has no journalctl\n"
    command = ["journalctl", "-u", NAME, "-n", str(_LINES), "--no-pager", "-o", "short-iso"]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_PATIENCE_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the journal cannot be read: {error}\n".encode()
    return done.stdout + done.stderr


def _faults(recording: Path) -> list[dict[str, Any]] | str:
    """Return the newest faults of a recording, or the reason why it cannot be read."""
    try:
        return [
            content
            for topic, content, _ in RecordedMessages(recording)
            if topic == schema.EVENT and content["kind"] == "fault"
        ][-_FAULTS:]
    except CellError as error:
        return str(error)
