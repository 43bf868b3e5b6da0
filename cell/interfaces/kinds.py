"""The built-in interfaces as plugins; the port of each is a key of `serve`."""

from importlib import import_module
from typing import Any, ClassVar, Literal

from cell.config.serve import InterfaceConfig
from cell.installation import extra
from cell.service.service import Service


class _BuiltIn(InterfaceConfig):
    module: ClassVar[str]
    name: ClassVar[str]
    """Module and class of the interface; its module is loaded only when it is opened."""

    def open(self, service: Service) -> Any:
        """Open it at the port of the config. Raises MissingExtraError, or OSError."""
        with extra("serve", needed_by=f"serve.{self.kind}_port"):
            interface_type = getattr(import_module(self.module), self.name)
        return interface_type(service)


class ModbusConfig(_BuiltIn):
    """Modbus TCP."""

    kind: Literal["modbus"] = "modbus"
    module, name = "cell.interfaces.modbus.registers", "ModbusInterface"


class XmlRpcConfig(_BuiltIn):
    """XML-RPC."""

    kind: Literal["xmlrpc"] = "xmlrpc"
    module, name = "cell.interfaces.xml_rpc", "XmlRpcInterface"


class HttpConfig(_BuiltIn):
    """HTTP, WebSocket and the page."""

    kind: Literal["http"] = "http"
    module, name = "cell.interfaces.web", "WebInterface"
