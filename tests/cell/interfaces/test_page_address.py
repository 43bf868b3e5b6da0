"""The address of the page: one that a browser opens, here and elsewhere."""

import socket
from typing import Any

import pytest

from cell.config.model import CellConfig
from cell.interfaces.page_address import page_address, view_note

TLS = {"tls_certificate": "c", "tls_key": "k"}


@pytest.mark.parametrize(
    ("listen", "allow", "more", "address", "note"),
    [
        ("127.0.0.1", (), {}, "http://127.0.0.1:7", "set serve.listen"),
        ("::1", (), TLS, "https://[::1]:7", "set serve.listen"),
        ("10.0.0.3", ("10.0.0.0/8",), {}, "http://10.0.0.3:7", ""),
        ("0.0.0.0", ("10.0.0.0/8",), {"hosts": ("cell3.lan",)}, "http://cell3.lan:7", ""),
        ("0.0.0.0", ("127.0.0.1",), {}, f"http://{socket.gethostname()}:7", "set serve.hosts"),
    ],
)
def test_the_address_of_the_page_suits_a_browser(*, listen, allow, more, address, note) -> None:
    config = CellConfig(serve={"listen": listen, "allow": allow} | more).serve
    assert page_address({"http_port": 7, "token": "t"}, config) == f"{address}/#token=t"
    assert page_address({"modbus_port": 7}, config) is None
    assert note in view_note(config)
    assert bool(note) is bool(view_note(config))


def test_the_address_for_others_is_that_of_this_machine_on_their_way(monkeypatch) -> None:
    asked = []

    class Link(socket.socket):
        def connect(self, address: Any) -> None:
            asked.append(address[0])
            if address[0].startswith("10."):
                raise OSError("no route")

        def getsockname(self) -> Any:
            return ("192.168.7.3", 40000)

    monkeypatch.setattr(socket, "socket", Link)
    config = CellConfig(
        serve={"listen": "0.0.0.0", "allow": ("10.0.0.0/8", "192.168.7.0/24")}
    ).serve
    found = page_address({"http_port": 7, "view_token": "v"}, config, "view_token")
    assert (found, view_note(config)) == ("http://192.168.7.3:7/#token=v", "")
    assert asked[:2] == ["10.128.0.0", "192.168.7.128"]
