"""What all doors share: who may connect, and how patient they are."""

from ipaddress import ip_address, ip_network

from cell.config.serve import ServeConfig

BUSY_MAX = 64
"""Connections at once on one door; further ones are closed at once."""
QUIET_S = 5.0
"""Longest time in s that a client may take for the rest of a message, or to take an answer."""


def may_connect(host: str, config: ServeConfig) -> bool:
    """Whether a host may connect: this machine, or one of the allow-list."""
    address = ip_address(host.partition("%")[0])
    mapped = getattr(address, "ipv4_mapped", None)
    found = address if mapped is None else mapped
    return found.is_loopback or any(found in ip_network(one) for one in config.allow)
