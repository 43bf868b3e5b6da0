"""Addresses of the page, for browsers of this machine and of others, and their QR codes."""

import socket
from collections.abc import Mapping
from contextlib import suppress
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING, Any

from cell.config.serve import ServeConfig
from cell.installation import extra

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
