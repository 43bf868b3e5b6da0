"""Opens all configured interfaces of a service; addresses of its page, and their QR codes."""

import asyncio
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from errno import EACCES, EADDRINUSE
from functools import partial
from ipaddress import ip_address, ip_network
from pathlib import Path
from pkgutil import resolve_name
from ssl import SSLError
from typing import TYPE_CHECKING, Any

from cell.config.serve import ServeConfig
from cell.errors import CellError, ConfigError
from cell.files import open_plain
from cell.installation import extra
from cell.service.service import Service

_INTERFACES = {
    "http_port": "cell.interfaces.web:WebInterface",
    "modbus_port": "cell.interfaces.modbus.registers:ModbusInterface",
    "xmlrpc_port": "cell.interfaces.xml_rpc:XmlRpcInterface",
}
"""Class of each interface by the key of its port. Its module is loaded only if the port is set.
Its ``serve`` is a coroutine that ``end`` ends; ``close`` closes its socket."""


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
    opened: dict[str, Any] = {"listen": config.listen}
    interfaces: dict[str, Any] = {}
    for key in ("tls_key", "tls_certificate"):
        if file := getattr(config, key):
            open_plain(Path(file), error=ConfigError, what=f"serve.{key}").close()
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
                remedy = ""
                if taken:
                    remedy = f"; set serve.{key} to another port, or to 0: any free port"
                elif isinstance(error, SSLError):
                    remedy = (
                        f"; serve.tls_certificate {config.tls_certificate} and serve.tls_key "
                        f"{config.tls_key} must be PEM files of one certificate and its key"
                    )
                raise CellError(
                    f"an interface at {config.listen}:{getattr(config, key)} (serve.{key}) "
                    f"cannot be opened: {error}{remedy}"
                ) from error
            undo.callback(interface.close)
            interfaces[key], opened[key] = interface, interface.port
            if key == "http_port":
                opened |= {"token": interface.token, "view_token": interface.view_token}
        undo.enter_context(running(service, interfaces))
        yield opened


@contextmanager
def running(service: Service, interfaces: Mapping[str, Any]) -> Iterator[None]:
    """Serve interfaces, by the keys of their ports, on one event loop in a thread of its own."""
    ended = set[str]()

    async def serve(key: str) -> None:
        try:
            await interfaces[key].serve()
        finally:
            ended.add(key)

    async def serve_all() -> None:
        for failure in await asyncio.gather(*map(serve, interfaces), return_exceptions=True):
            if failure is not None:
                loop.call_exception_handler(
                    {"message": "an interface failed", "exception": failure}
                )

    def run() -> None:
        with runner:
            runner.run(serve_all())

    runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
    loop = runner.get_loop()
    thread = threading.Thread(target=run, name="interfaces", daemon=True)
    with ExitStack() as watched:
        for key in interfaces:
            works = partial(ended.isdisjoint, (key,))
            watched.enter_context(service.watching(f"the interface of serve.{key}", works))
        thread.start()
        try:
            yield
        finally:
            with suppress(RuntimeError):  # the loop has ended
                for interface in interfaces.values():
                    loop.call_soon_threadsafe(interface.end)
            thread.join()


if TYPE_CHECKING:
    from segno import QRCode


def own_address(config: ServeConfig) -> str:
    """Return the name or address of this machine for other machines; empty if none can connect.

    If the cell listens at all addresses, it is the first of ``hosts``. Without hosts, it is the
    address from which this machine would send to a network of the allow-list. Nothing is sent.
    """
    listen = ip_address(config.listen)
    if not listen.is_unspecified:
        return "" if listen.is_loopback else config.listen
    if config.hosts:
        return config.hosts[0]
    family = socket.AF_INET6 if listen.version == 6 else socket.AF_INET
    for network in map(ip_network, config.allow):
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as link:
            link.connect((str(network[network.num_addresses // 2]), 9))
            address = str(link.getsockname()[0])
            if not ip_address(address).is_loopback:
                return address
    return ""


def page_address(
    interfaces: Mapping[str, Any], config: ServeConfig, token: str = "token"
) -> str | None:
    """Return the address of the page, with a token, for a browser; None without HTTP.

    Parameters
    ----------
    interfaces
        The interfaces, as `cell.interfaces.opening.open_interfaces` yields them.
    token
        Key of the token in ``interfaces``; ``view_token``: view only.
    """
    if "http_port" not in interfaces:
        return None
    anywhere = ip_address(config.listen).is_unspecified
    host = own_address(config) or (socket.gethostname() if anywhere else config.listen)
    host = f"[{host}]" if ":" in host else host
    scheme = "https" if config.tls_certificate else "http"
    return f"{scheme}://{host}:{interfaces['http_port']}/#token={interfaces[token]}"


def view_note(config: ServeConfig) -> str:
    """Return the settings that other machines need to reach the page; empty if they reach it."""
    if ip_address(config.listen).is_loopback:
        return (
            f"only this machine reaches {config.listen}: set serve.listen to 0.0.0.0, and "
            "serve.allow to the hosts that may connect"
        )
    if own_address(config):
        return ""
    return (
        f"this machine has no route to {', '.join(config.allow)} (serve.allow): set serve.hosts to "
        "its name or address for other machines"
    )


def qr_code(address: str) -> "QRCode":
    """Return the QR code of an address. Raises MissingExtraError without the extra ``serve``."""
    with extra("serve", needed_by="the QR code"):
        import segno  # noqa: PLC0415
    return segno.make_qr(address)
