"""Opens a service: the cell behind it, and all its configured doors, closed in order."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from cell.config.model import CellConfig
from cell.errors import CellError, ConfigError
from cell.interfaces.plugin.plugin import TactileCellPlugin
from cell.interfaces.service.pose_handshake import PoseHandshake
from cell.interfaces.service.service import Service
from gripper.state import Clock


def open_service(
    config: CellConfig,
    *,
    note: Callable[[str], None] = lambda _text: None,
    clock: Clock = time,
    **cell: Any,
) -> Service:
    """Open a cell and return the service of it.

    Parameters
    ----------
    config
        The cell. A positioner of kind ``callback`` is the pose handshake; ``host_timeout_s`` does
        not count, because the service watches its clients by the lease.
    note, clock
        As `Service`.
    cell
        Model, folder of the recording and more, as `TactileCellPlugin` takes them.

    Raises
    ------
    As `TactileCellPlugin`.
    """
    config = config.model_copy(update={"host_timeout_s": None})
    poses = PoseHandshake()
    mover = poses.move if config.positioner.kind == "callback" else None
    plugin = TactileCellPlugin(config, mover=mover, **cell)
    return Service(plugin, config, poses=poses, note=note, clock=clock)


def warnings(service: Service) -> tuple[str, ...]:
    """Return what the operator should have in mind about the configured doors."""
    config = service.config.serve
    notes = []
    if not ip_address(config.listen).is_loopback:
        if config.modbus_port is not None or config.xmlrpc_port is not None:
            weakness = (
                "send their secret in the clear" if config.secret_file else "authenticate nobody"
            )
            notes.append(
                f"Modbus and XML-RPC {weakness}: who reaches {config.listen} from "
                f"{', '.join(config.allow)} can move the gripper; use a network of the cell alone"
            )
        if config.http_port is not None and not config.tls_certificate:
            notes.append("HTTP without TLS sends its token in the clear; set serve.tls_certificate")
    return tuple(notes)


@contextmanager
def open_doors(service: Service) -> Iterator[dict[str, Any]]:
    """Open all configured doors; yield their ports, and the token of HTTP.

    Raises
    ------
    CellError
        If a door cannot be opened; ConfigError, if none is configured or an extra is missing.
    """
    config = service.config.serve
    found: dict[str, Any] = {"listen": config.listen}
    files = (config.secret_file, config.token_file, config.tls_certificate, config.tls_key)
    for name in files:
        if name and Path(name).exists() and not Path(name).is_file():
            raise ConfigError(f"{name}: not a plain file; name the file itself")
    with ExitStack() as undo:
        try:
            if config.modbus_port is not None:
                from cell.interfaces.modbus.registers import ModbusDoor  # noqa: PLC0415

                modbus = ModbusDoor(service)
                undo.callback(modbus.close)
                found["modbus_port"] = modbus.port
            if config.xmlrpc_port is not None:
                from cell.interfaces.xml_rpc import XmlRpcDoor  # noqa: PLC0415

                xml_rpc = XmlRpcDoor(service)
                undo.callback(xml_rpc.close)
                found["xmlrpc_port"] = xml_rpc.port
            if config.http_port is not None:
                from cell.interfaces.web import WebDoor  # noqa: PLC0415

                web = WebDoor(service)
                undo.callback(web.close)
                found |= {"http_port": web.port, "token": web.token}
            if config.opcua_port is not None:
                from cell.interfaces.opc_ua.door import OpcUaDoor  # noqa: PLC0415

                opc_ua = OpcUaDoor(service)
                undo.callback(opc_ua.close)
                found["opcua_port"] = opc_ua.port
        except ImportError as error:
            raise ConfigError(
                "serve.http_port needs the extra tactile-cell[serve], serve.opcua_port "
                f"tactile-cell[opcua] ({error})"
            ) from error
        except OSError as error:
            raise CellError(f"a door at {config.listen} cannot be opened: {error}") from error
        if len(found) == 1:
            raise ConfigError("no door is open: set a port in `serve`, or give --modbus 0")
        yield found
