"""Config of `tactile-cell serve`: interfaces, allowed clients, the lease."""

import re
from contextlib import suppress
from ipaddress import ip_address, ip_network
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from cell.config.section import Section, refuse_repeats
from cell.files import checked_label


def _address(text: str) -> str:
    """Return an IP address or network in its usual form."""
    return str(ip_network(text, strict=False) if "/" in text else ip_address(text))


def _host(text: str) -> str:
    """Return a name or address, without port, for comparison with the header ``Host``."""
    with suppress(ValueError):
        return str(ip_address(text))
    if not re.fullmatch(r"\w([\w.-]{0,251}\w)?", text, re.ASCII):
        raise ValueError(f"{text!r} is not a host name or address; write, for example, cell.lan")
    return text.lower()


ALL_CLOSED = (
    "no interface is open: set serve.http_port, serve.modbus_port or serve.xmlrpc_port, or start "
    "`serve` with --http, --modbus or --xml-rpc and a port"
)
"""Error of a service that no client reaches."""

Port = Annotated[int, Field(ge=0, le=65535)]
"""TCP port; 0: any free one."""


class ServeConfig(Section):
    """Interfaces of `tactile-cell serve`; Modbus and XML-RPC have no user authentication."""

    listen: Annotated[str, AfterValidator(_address)] = "127.0.0.1"
    """Address for clients; any other address than 127.0.0.1 needs `allow`."""
    allow: tuple[Annotated[str, AfterValidator(_address)], ...] = Field(default=(), max_length=100)
    """Hosts or networks that may connect, for example 192.168.1.10 or 192.168.1.0/24; this machine
    always may."""
    hosts: tuple[Annotated[str, AfterValidator(_host)], ...] = Field(default=(), max_length=100)
    """Further names and addresses of this machine, without port, in requests over HTTP or XML-RPC.
    localhost, its host name and its own address are always allowed; others are refused."""
    request_timeout_s: float = Field(default=5.0, ge=0.1, le=60.0)
    """Longest time in s until the last byte of a request, 0.1 to 60; then the connection is closed.
    After an answer over HTTP or XML-RPC it begins after the longest permitted silence."""
    modbus_port: Port | None = None
    """Port of Modbus TCP, for PLCs, e.g. 5020; 0: any free port; none: closed. Port 502 needs extra
    rights."""
    xmlrpc_port: Port | None = None
    """Port of XML-RPC, for robot programs, e.g. 5021; 0: any free port; none: closed."""
    http_port: Port | None = None
    """Port of HTTP and WebSocket (extra `serve`), e.g. 8080; 0: any free port; none: closed."""
    lease_timeout_s: float = Field(default=2.0, ge=0.2, le=60.0)
    """Longest silence of the client in command in s, 0.2 to 60; then a running job is held."""
    objects: tuple[Annotated[str, AfterValidator(checked_label)], ...] = Field(
        default=(), max_length=1000
    )
    """Labels in the order of their ids from 1, for hosts that use numbers; other labels follow."""
    shift_begins_h: tuple[Annotated[float, Field(ge=0.0, lt=24.0)], ...] = Field(
        default=(0.0,), min_length=1, max_length=24
    )
    """Hours of the local day at which a shift begins, as [6, 14, 22]; its figures begin anew then,
    and go on after a restart."""
    token_file: str = Field(default="", max_length=500)
    """File with the token of HTTP clients; empty: each start prints a new token."""
    secret_file: str = Field(default="", max_length=500)
    """File with the secret, 16 to 64 letters, digits or -._~; clients of Modbus and XML-RPC need it
    to command. Empty: no secret is needed."""
    tls_certificate: str = Field(default="", max_length=500)
    """Certificate file (PEM) of HTTP; empty: no TLS."""
    tls_key: str = Field(default="", max_length=500)
    """Key file (PEM) of the certificate."""

    @property
    def ports(self) -> tuple[int, ...]:
        """Ports of the interfaces that are not closed."""
        ports = (self.modbus_port, self.xmlrpc_port, self.http_port)
        return tuple(port for port in ports if port is not None)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not ip_address(self.listen).is_loopback and not self.allow:
            raise ValueError(
                f"serve.listen is {self.listen} and serve.allow is empty: name the hosts that may "
                "connect"
            )
        if bool(self.tls_certificate) != bool(self.tls_key):
            raise ValueError("set both serve.tls_certificate and serve.tls_key, or neither")
        ports = (port for port in self.ports if port)
        refuse_repeats(ports, "serve.modbus_port, xmlrpc_port and http_port")
        refuse_repeats(self.objects, "labels of serve.objects")
        return self
