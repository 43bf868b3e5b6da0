"""OPC UA: the interface for SCADA, MES and controllers; nodes and methods."""

import asyncio
import inspect
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.ua import StatusCodes
from cryptography.x509 import ExtensionNotFound

from cell.errors import ConfigError
from cell.fault_catalogue import BY_NUMBER
from cell.interfaces.host_calls import Calls, methods
from cell.interfaces.host_values import PLATE, REFUSAL, VALUES, ur_pose
from cell.interfaces.opc_ua.server import CellServer, Clients, Sessions
from cell.service.service import Service, Snapshot

NAMESPACE = "urn:tactile-cell:cell"
"""Namespace of the nodes; their ids are their paths, as ``Cell.Job.Label``."""
PERIOD_S = 0.1
"""Time in s between two updates of the values."""
_INT, _REAL, _TEXT = ua.VariantType.Int32, ua.VariantType.Double, ua.VariantType.String
_TYPES = {bool: ua.VariantType.Boolean, int: _INT, float: _REAL, str: _TEXT}
NODES: dict[str, tuple[ua.VariantType, str]] = {
    **{one.node: (_TYPES[one.kind], one.text) for one in PLATE},
    "Identification.Labels": (_TEXT, "Labels by their id, from 1"),
    **{one.node: (_TYPES[one.kind], one.text) for one in VALUES},
    "Pose.Value": (_REAL, "That pose in m, with a rotation vector in rad"),
    "Taxels": (ua.VariantType.UInt16, "Counts of the newest frame"),
    **{one.node: (_TYPES[one.kind], one.text) for one in REFUSAL},
}
"""Type and text of each variable by its path; a missing value has a bad status."""
ARRAYS = ("Identification.Labels", "Pose.Value", "Taxels")
"""Paths of variables that are arrays."""
FAULT_EVENT, SHUTDOWN_EVENT = "CellFault", "CellShutdown"
"""Event types of the object Server. `FAULT_EVENT`: a fault is latched; it has the fields of the
variables with these names, and the remedy. `SHUTDOWN_EVENT`: the interface closes."""
_SEVERITY = 700
"""Severity of events, 1 to 1000: high."""
_EVENT_FIELDS = (("FaultNumber", _INT), ("FaultText", _TEXT), ("Remedy", _TEXT))


class OpcUaInterface:
    """The cell behind OPC UA.

    Raises OSError if it cannot listen at the configured address and port, or cannot read a file,
    and ConfigError if a certificate is invalid.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        self._calls = Calls(service, interface="OPC UA")
        self._fault: str | None = None
        started: Future[int] = Future()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._run(started)), name="opc-ua", daemon=True
        )
        self._thread.start()
        try:
            self.port: int = started.result()
        except (ValueError, ExtensionNotFound) as error:
            folder = service.config.serve.opcua_folder
            raise ConfigError(
                f"serve.opcua_folder {folder}: a certificate or key cannot be used ({error}); "
                "use .der or .pem files; the certificate of the cell needs one URI"
            ) from error

    def close(self) -> None:
        """End all connections and the thread."""
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    async def _run(self, started: "Future[int]") -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        config = self._service.config.serve
        trusted = Path(config.opcua_folder) / "trusted" if config.opcua_folder else None
        clients = Clients(trusted)
        server = CellServer(Sessions(clients, config))
        try:
            if trusted is not None:
                trusted.mkdir(parents=True, exist_ok=True)
                await clients.load()
            await server.init()
            if trusted is not None:
                await server.use_certificate(trusted.parent)
            space = await self._add_nodes(server)
            await self._show(server, space)
            await server.start()
            fault, shutdown = await self._add_events(server, space)
        except Exception as error:
            started.set_exception(error)
            return
        started.set_result(server.bserver.port)
        while not self._over.is_set():
            now = await self._show(server, space)
            if now is not None and now.status.fault != self._fault:
                self._fault = now.status.fault
                if self._fault is not None:
                    fault.event.FaultNumber = now.status.fault_number
                    fault.event.FaultText = self._fault
                    fault.event.Remedy = BY_NUMBER[now.status.fault_number].remedy
                    await fault.trigger(message=self._fault)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._over.wait(), PERIOD_S)
        if server.iserver.subscription_service.subscriptions:
            await shutdown.trigger(message="The program of the cell ends; a held part stays held.")
            await asyncio.sleep(2 * PERIOD_S)  # until it is sent
        await server.stop()

    async def _add_events(self, server: CellServer, space: int) -> tuple[Any, Any]:
        """Return the generators of the events of a fault and of the end."""
        made = []
        for name, fields in ((FAULT_EVENT, _EVENT_FIELDS), (SHUTDOWN_EVENT, ())):
            kind = await server.create_custom_event_type(space, name, properties=list(fields))
            sender = await server.get_event_generator(kind)
            sender.event.SourceNode, sender.event.SourceName = _id("", space), "Cell"
            sender.event.Severity = _SEVERITY
            made.append(sender)
        return made[0], made[1]

    async def _add_nodes(self, server: CellServer) -> int:
        space: int = await server.register_namespace(NAMESPACE)
        name = partial(ua.QualifiedName, NamespaceIndex=space)
        cell = await server.nodes.objects.add_object(_id("", space), name("Cell"))
        groups = {"": cell}
        for path, (kind, text) in NODES.items():
            group, _, last = path.rpartition(".")
            if group not in groups:
                groups[group] = await cell.add_object(_id(group, space), name(group))
            empty = [] if path in ARRAYS else ua.get_default_value(kind)
            node = await groups[group].add_variable(_id(path, space), name(last), empty, kind)
            await _describe(node, text)
        for path, call in called_methods(self._calls).items():
            taken = inspect.signature(call)
            types = {one.name: one.annotation for one in taken.parameters.values()}
            inputs = [ua.Argument(one, ua.NodeId(_TYPES[t].value), -1) for one, t in types.items()]
            outputs = [ua.Argument("result", ua.NodeId(_TYPES[taken.return_annotation].value), -1)]
            at = _id(path, space), name(path)
            node = await cell.add_method(*at, partial(_called, call), inputs, outputs)
            await _describe(node, inspect.getdoc(call) or "")
        return space

    async def _show(self, server: CellServer, space: int) -> Snapshot | None:
        """Write all values and return them; without a snapshot mark all as bad, return None."""
        now = None
        found: dict[str, Any] = {}
        missing = StatusCodes.BadNoData
        try:
            now = await asyncio.to_thread(self._service.snapshot)
            counts = now.status.live.counts
            found = {
                "Identification.Labels": list(self._service.labels),
                "Pose.Value": list(ur_pose(now.pose).values()),
                "Taxels": None if counts is None else counts.tolist(),
            }
            shown = (now, VALUES), (self._service, PLATE), (self._calls.refusal, REFUSAL)
            found |= {one.node: one.of(what) for what, values in shown for one in values}
        except Exception:
            missing = StatusCodes.BadNoCommunication
        for path, (kind, _) in NODES.items():
            value = found.get(path)
            variant = ua.Variant() if value is None else ua.Variant(value, kind)
            status = ua.StatusCode(missing if value is None else StatusCodes.Good)
            data = ua.DataValue(variant, status, SourceTimestamp=datetime.now(UTC))
            await server.write_attribute_value(_id(path, space), data)
        return now


def called_methods(calls: Calls) -> dict[str, Callable[..., Any]]:
    """Return the methods of XML-RPC that have arguments; others are variables here."""
    every = methods(calls)

    def acquire(name: str) -> int:
        """Return the number of the lease for commands; keep it with `alive`."""
        return int(every["acquire"](name))

    of_cell = {name: call for name, call in every.items() if inspect.signature(call).parameters}
    return of_cell | {"acquire": acquire}


def _called(call: Callable[..., Any], _parent: Any, *given: ua.Variant) -> list[ua.Variant]:
    """Call a method with the arguments of asyncua, which calls it in a separate thread."""
    kind = _TYPES[inspect.signature(call).return_annotation]
    return [ua.Variant(call(*(one.Value for one in given)), kind)]


def _id(path: str, space: int) -> ua.NodeId:
    return ua.NodeId(f"Cell.{path}".rstrip("."), space)


async def _describe(node: Any, text: str) -> None:
    value = ua.DataValue(ua.Variant(ua.LocalizedText(text)))
    await node.write_attribute(ua.AttributeIds.Description, value)
