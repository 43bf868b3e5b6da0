"""Opens all configured interfaces of a service, and closes them in order."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from errno import EACCES, EADDRINUSE
from ipaddress import ip_address
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from cell.errors import CellError, ConfigError
from cell.installation import extra
from cell.service.service import Service

_INTERFACES = {
    "http_port": "cell.interfaces.web:WebInterface",
    "modbus_port": "cell.interfaces.modbus.registers:ModbusInterface",
    "xmlrpc_port": "cell.interfaces.xml_rpc:XmlRpcInterface",
}
"""Class of each interface by the key of its port. Its module is loaded only if the port is set."""


def warnings(service: Service) -> tuple[str, ...]:
    """Return security warnings about the configured interfaces."""
    config = service.config.serve
    notes = []
    if not ip_address(config.listen).is_loopback:
        if config.modbus_port is not None or config.xmlrpc_port is not None:
            weakness = (
                "send their secret unencrypted" if config.secret_file else "authenticate nobody"
            )
            notes.append(
                f"Modbus and XML-RPC {weakness}: any program on {', '.join(config.allow)} that "
                f"reaches {config.listen} can move the gripper; use a separate network"
            )
        if config.http_port is not None and not config.tls_certificate:
            notes.append("HTTP without TLS sends its token unencrypted; set serve.tls_certificate")
    return tuple(notes)


@contextmanager
def open_interfaces(service: Service) -> Iterator[dict[str, Any]]:
    """Open all configured interfaces; yield their ports, and the token of HTTP.

    Raises CellError if an interface cannot be opened, and ConfigError if an extra is missing.
    """
    config = service.config.serve
    found: dict[str, Any] = {"listen": config.listen}
    for name in (config.tls_certificate, config.tls_key):
        if name and Path(name).exists() and not Path(name).is_file():
            raise ConfigError(f"{name}: not a plain file; name the file itself")
    with ExitStack() as undo:
        for key, name in _INTERFACES.items():
            if getattr(config, key) is None:
                continue
            try:
                with extra("serve", needed_by=f"serve.{key}"):
                    make = resolve_name(name)
                interface = make(service)
            except OSError as error:
                taken = error.errno in (EADDRINUSE, EACCES) and error.filename is None
                remedy = (
                    f"; set serve.{key} to another port, or to 0: any free port" if taken else ""
                )
                raise CellError(
                    f"an interface at {config.listen}:{getattr(config, key)} (serve.{key}) "
                    f"cannot be opened: {error}{remedy}"
                ) from error
            undo.callback(interface.close)
            undo.enter_context(service.watching(f"the interface of serve.{key}", interface.works))
            found[key] = interface.port
            if key == "http_port":
                found |= {"token": interface.token, "view_token": interface.view_token}
        yield found
