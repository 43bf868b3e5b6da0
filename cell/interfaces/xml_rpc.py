"""XML-RPC: the interface for robot programs.

A robot program waits for each call and stops at an error. So no call takes longer than 100 ms or
raises an error. The calls are in `cell.interfaces.host_calls`.
"""

import asyncio
import inspect
from typing import Any, cast
from xmlrpc.server import SimpleXMLRPCDispatcher

from cell.interfaces.access import read_secret
from cell.interfaces.host_calls import CLIENT, Calls, methods
from cell.interfaces.http_server import HttpServer, Scope, Send, refuse, send_answer
from cell.service.service import Service

_PATHS = ("/", "/RPC2")
"""Paths of the calls."""
_REMEDY = f"POST calls to {_PATHS[1]}, as text/xml in UTF-8, without compression and DOCTYPE."
"""Remedy for a request that is not a call."""
_IDLE_S = 60
"""Silence in s after which a connection is closed; robots reconnect by themselves."""
_TYPES = {int: "int", float: "double", bool: "boolean", str: "string"}
"""Names of the types in XML-RPC."""


class _Dispatcher(SimpleXMLRPCDispatcher):
    """Answers calls; an ASGI application."""

    async def __call__(self, scope: Scope, receive: Any, send: Send) -> None:
        """Answer a request; refuse requests that a web page could send, and compressed ones."""
        fields = {name: value.decode("latin-1").lower() for name, value in scope["headers"]}
        body, more = b"", True
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":  # an incomplete request is ignored
                return
            body += message["body"]
            more = message.get("more_body", False)
        if scope["path"] not in _PATHS:
            await refuse(send, 404, f"{scope['path']!r:.80} takes no calls", _REMEDY)
        elif scope["method"] != "POST":
            await refuse(send, 405, f"{scope['method']} is not a call", _REMEDY)
        elif fields.get(b"content-type", "").partition(";")[0].strip() != "text/xml":
            await refuse(send, 403, "the Content-Type is not text/xml", _REMEDY)
        elif (coding := fields.get(b"content-encoding", "identity")) != "identity":
            await refuse(send, 501, f"Content-Encoding {coding!r:.40} is not supported", _REMEDY)
        elif (call := _decoded(body)) is None:
            await refuse(send, 501, "the call is not in UTF-8, or has a DOCTYPE", _REMEDY)
        else:
            CLIENT.set(scope["client"][0])
            found = await asyncio.to_thread(self._marshaled_dispatch, call)
            await send_answer(send, 200, cast("bytes", found), "text/xml")

    def system_methodSignature(self, method_name: str) -> Any:  # noqa: N802  name of the base class
        """Return one list with the types of a method: first the result, then the arguments."""
        if method_name not in self.funcs or method_name.startswith("system."):
            return super().system_methodSignature(method_name)
        found = inspect.signature(self.funcs[method_name])
        taken = (one.annotation for one in found.parameters.values())
        return [[_TYPES.get(one, "struct") for one in (found.return_annotation, *taken)]]


def _decoded(body: bytes) -> str | None:
    """Return a call as text; None in another encoding or with a document type.

    The parser takes a text as UTF-8, whatever encoding its first line names; only null bytes would
    make it UTF-16.
    """
    try:
        call = body.decode()
    except UnicodeDecodeError:
        return None
    return None if "<!" in call or "\0" in call else call


class XmlRpcInterface(HttpServer):
    """The cell behind XML-RPC.

    Raises OSError if it cannot listen at the configured address and port, or cannot read the file
    of the secret, and ConfigError if the secret is too short.
    """

    def __init__(self, service: Service) -> None:
        config = service.config.serve
        secret = read_secret(config.secret_file) if config.secret_file else ""
        calls = _Dispatcher(allow_none=False)
        calls.register_introspection_functions()
        for name, method in methods(Calls(service, secret)).items():
            calls.register_function(method, name)
        super().__init__(calls, config, config.xmlrpc_port or 0, name="xml-rpc", idle_s=_IDLE_S)
