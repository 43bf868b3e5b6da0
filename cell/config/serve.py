"""Config of `tactile-cell serve`: interfaces, who may connect, the lease."""

import re
from contextlib import suppress
from ipaddress import ip_address, ip_network
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from cell.config.section import Section
from cell.config.simulator import checked_label


def _address(text: str) -> str:
    """Return an IP address or network as it is usually written."""
    return str(ip_network(text, strict=False) if "/" in text else ip_address(text))


def _host(text: str) -> str:
    """Return a name or address, without port, as it is compared with the header ``Host``."""
    with suppress(ValueError):
        return str(ip_address(text))
    if not re.fullmatch(r"\w([\w.-]{0,251}\w)?", text, re.ASCII):
        raise ValueError(f"{text!r} is no host name or address; write it without port, as cell.lan")
    return text.lower()


Port = Annotated[int, Field(ge=0, le=65535)]
"""TCP port; 0: any free one."""


class ServeConfig(Section):
    """Interfaces of `tactile-cell serve`; Modbus and XML-RPC authenticate nobody."""

    listen: Annotated[str, AfterValidator(_address)] = "127.0.0.1"
    """Address that clients reach; another one than 127.0.0.1 needs `allow`."""
    allow: tuple[Annotated[str, AfterValidator(_address)], ...] = Field(default=(), max_length=100)
    """Hosts or networks that may connect, as 192.168.1.10 or 192.168.1.0/24; this one always."""
    hosts: tuple[Annotated[str, AfterValidator(_host)], ...] = Field(default=(), max_length=100)
    """Names and addresses, without port, by which clients reach this machine over HTTP or XML-RPC,
    beside localhost, its host name and the address that they reach it at; others are refused."""
    request_timeout_s: float = Field(default=5.0, ge=0.1, le=60.0)
    """Longest time in s from the first to the last byte of a request, 0.1 to 60; later the
    connection is closed."""
    modbus_port: Port | None = 5020
    """Port of Modbus TCP, for PLCs; 0: any free one; none: closed. 502 needs the right to it."""
    xmlrpc_port: Port | None = 5021
    """Port of XML-RPC, for robot programs; 0: any free one; none: closed."""
    http_port: Port | None = None
    """Port of HTTP and WebSocket (extra `serve`); 0: any free one; none: closed."""
    opcua_port: Port | None = None
    """Port of OPC UA (extra `opcua`), 4840 by custom; 0: any free one; none: closed."""
    opcua_folder: str = Field(default="", max_length=500)
    """Certificates of OPC UA: certificate.der and key.pem of the cell, made at the first start, and
    in trusted/ those of the clients that may command; empty: read-only."""
    lease_timeout_s: float = Field(default=2.0, ge=0.2, le=60.0)
    """Longest silence of the client in command in s, 0.2 to 60; then a job that runs is held."""
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
    """File with the token of HTTP clients; empty: a new one at each start, which is printed."""
    secret_file: str = Field(default="", max_length=500)
    """File with the secret, 16 to 64 ASCII characters, without which no client of Modbus or XML-RPC
    commands; empty: none is asked for."""
    tls_certificate: str = Field(default="", max_length=500)
    """Certificate file (PEM) of HTTP; empty: no TLS."""
    tls_key: str = Field(default="", max_length=500)
    """Key file (PEM) of the certificate."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not ip_address(self.listen).is_loopback and not self.allow:
            raise ValueError(
                f"serve.listen is {self.listen} and serve.allow is empty: name the hosts that may "
                "connect"
            )
        if bool(self.tls_certificate) != bool(self.tls_key):
            raise ValueError("serve.tls_certificate and serve.tls_key need each other")
        if len(set(self.objects)) != len(self.objects):
            raise ValueError("serve.objects names a label twice: each has one id")
        return self
