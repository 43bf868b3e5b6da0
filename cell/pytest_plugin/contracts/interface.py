"""Contract of an interface of `serve`."""

import socket
from contextlib import closing

import pytest

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.interfaces.opening import open_interfaces
from cell.plugins import INTERFACES
from cell.pytest_plugin.configs import simulated_config
from cell.service.opening import open_service


def test_it_listens_until_it_is_closed(plugin_name: str, cell_config: CellConfig) -> None:
    changes: dict[str, object] = {
        f"serve.{name}_port": None for name in INTERFACES if INTERFACES.built_in(name)
    }
    if INTERFACES.built_in(plugin_name):
        changes[f"serve.{plugin_name}_port"] = 0
    else:
        changes["serve.interfaces"] = [{"kind": plugin_name}]
    config = changed_config(simulated_config(cell_config), changes)
    with closing(open_service(config)) as service:
        with open_interfaces(service) as found:
            place = (config.serve.listen, found[f"{plugin_name}_port"])
            with pytest.raises(OSError, match="in use"):
                socket.create_server(place).close()
        socket.create_server(place).close()
