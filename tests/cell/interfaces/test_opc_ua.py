"""OPC UA with asyncua's client: reading needs nothing, commands a trusted certificate."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("asyncua", reason="the extra opcua is not installed")

from asyncua import Client, Node, Server, ua
from asyncua.common.connection import MessageChunk
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties
from asyncua.server.binary_server_asyncio import OPCUAProtocol
from asyncua.server.internal_session import InternalSession
from asyncua.ua.uaerrors import (
    BadCertificateUntrusted,
    BadIdentityTokenRejected,
    BadNoData,
    BadServiceUnsupported,
    BadSessionIdInvalid,
    BadUserAccessDenied,
)

from cell.control.states import Command
from cell.errors import CellError, ConfigError
from cell.interfaces.host_values import VALUES
from cell.interfaces.opc_ua.interface import (
    FAULT_EVENT,
    NAMESPACE,
    NODES,
    PERIOD_S,
    SHUTDOWN_EVENT,
    OpcUaInterface,
)
from cell.interfaces.opening import open_interfaces
from tactile.errors import FrameTimeout
from tests.cell.interfaces.certificates import Identity, identity, trusting
from tests.cell.served import Served, serving
from tests.values import raising
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.anyio
ENCRYPTED = ua.MessageSecurityMode.SignAndEncrypt


@pytest.fixture(scope="module")
def plc() -> Identity:
    return identity("plc")


@pytest.fixture
def folder(tmp_path: Path, plc: Identity) -> Path:
    """Return a folder of OPC UA that trusts the PLC."""
    return trusting(tmp_path, plc)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory, plc: Identity) -> Iterator[Served]:
    """An interface for what changes nothing: to open one takes more than a second."""
    folder = trusting(tmp_path_factory.mktemp("pki"), plc)
    with serving("opcua", serve__opcua_folder=str(folder)) as served:
        yield served


class Link:
    """A client and the cell that it sees."""

    def __init__(self, client: Client, space: int) -> None:
        self.client = client
        self.space = space
        self.cell = self.node("")

    def node(self, path: str) -> Node:
        return self.client.get_node(ua.NodeId(f"Cell.{path}".rstrip("."), self.space))

    async def read(self, path: str) -> Any:
        return await self.node(path).read_value()

    async def call(self, method: str, *arguments: Any) -> Any:
        return await self.cell.call_method(f"{self.space}:{method}", *arguments)

    async def until(self, path: str, true: Callable[[Any], bool]) -> Any:
        async with asyncio.timeout(LIMIT_S):
            while not true(found := await self.read(path)):
                await asyncio.sleep(0.02)
        return found

    async def ended(self, number: int) -> None:
        """Wait until the variables show the end of a job."""
        await self.until("Job.Number", lambda found: found == number)
        await self.until("Job.State", lambda found: found >= 4)


def url(served: Any) -> str:
    return f"opc.tcp://127.0.0.1:{served.interfaces['opcua_port']}/"


@asynccontextmanager
async def linked(served: Any, who: Identity | None = None) -> AsyncIterator[Link]:
    client = Client(url(served), timeout=LIMIT_S)
    if who is not None:
        client.application_uri = "urn:plc"
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            certificate=who.der,
            private_key=CertProperties(who.pem, "pem"),
            mode=ENCRYPTED,
        )
    async with client:
        yield Link(client, await client.get_namespace_index(NAMESPACE))


@pytest.fixture
def open_cell(serve: Any, folder: Path) -> Callable[..., Any]:
    """Return the maker of services with an interface that trusts the PLC."""
    return lambda **changes: serve("opcua", serve__opcua_folder=str(folder), **changes)


# -- who may do what ---------------------------------------------------------------------------


async def test_an_anonymous_session_reads_and_does_nothing_else(opened) -> None:
    async with linked(opened) as link:
        assert await link.read("State.Name") == "IDLE"
        methods = await link.cell.get_children(nodeclassmask=ua.NodeClass.Method)
        names = [(await node.read_browse_name()).Name for node in methods]
        assert {"hold", "acquire", "identify", "release", "label"} <= set(names)
        for name in names:
            with pytest.raises(BadUserAccessDenied):
                await link.call(name)
        with pytest.raises(BadUserAccessDenied):
            await link.call("acquire", "nobody")
        for path in NODES:
            with pytest.raises(BadUserAccessDenied):
                await link.node(path).write_value(1)
        with pytest.raises(BadUserAccessDenied):
            await link.cell.add_variable(link.space, "More", 1)
        _, (status,) = await link.client.delete_nodes([link.cell])
        assert status.value == ua.StatusCodes.BadUserAccessDenied
        with pytest.raises(BadServiceUnsupported):
            await link.client.register_server(Server())
        assert await link.read("State.Commander") == ""
    assert opened.service.job().number == 0
    opened.service.lease.give_up(opened.service.lease.acquire("free"))


async def test_no_name_and_no_password_opens_a_session(opened) -> None:
    for name in ("admin", "Admin", "plc"):
        client = Client(url(opened), timeout=LIMIT_S)
        client.set_user(name)
        client.set_password("any")
        with pytest.raises(BadIdentityTokenRejected):
            await client.connect()


async def test_a_certificate_that_a_plain_channel_names_proves_nothing(
    opened, plc, monkeypatch
) -> None:
    honest = MessageChunk.message_to_chunks
    named: list[bytes] = []

    def naming(*arguments: Any, **more: Any) -> Any:
        chunks = honest(*arguments, **more)
        if more["message_type"] == ua.MessageType.SecureOpen:
            chunks[0].SecurityHeader.SenderCertificate = plc.der
            named.append(plc.der)
        return chunks

    monkeypatch.setattr(MessageChunk, "message_to_chunks", staticmethod(naming))
    async with linked(opened) as link:
        assert await link.read("State.Name") == "IDLE"
        with pytest.raises(BadUserAccessDenied):
            await link.call("acquire", "nobody")
    assert named


async def test_a_session_without_a_channel_calls_nothing(opened) -> None:
    client = Client(url(opened), timeout=LIMIT_S)
    await client.connect_socket()
    await client.send_hello()
    await client.create_session()
    await client.activate_session()
    link = Link(client, await client.get_namespace_index(NAMESPACE))
    with pytest.raises(BadUserAccessDenied):
        await link.call("acquire", "nobody")
    with pytest.raises(BadUserAccessDenied):
        await link.node("State.Name").write_value("RUN")
    client.disconnect_socket()


async def test_a_session_of_another_client_cannot_be_taken(opened, plc) -> None:
    async with linked(opened, plc) as link:
        thief = Client(url(opened), timeout=LIMIT_S)
        await thief.connect_socket()
        await thief.send_hello()
        await thief.open_secure_channel()
        thief._server_nonce = b""
        # Numbers that asyncua itself gives to sessions.
        for guess in range(1000, InternalSession._auth_counter + 1):
            thief.uaclient.protocol.authentication_token = ua.NodeId(guess)
            with pytest.raises(BadSessionIdInvalid):
                await thief.activate_session()
            with pytest.raises(BadUserAccessDenied):
                await Link(thief, link.space).call("acquire", "thief")
        thief.disconnect_socket()
        assert await link.call("give_up", await link.call("acquire", "plc")) == 0


async def test_only_encrypted_channels_of_trusted_certificates_command(
    open_cell, folder, plc
) -> None:
    served = open_cell()
    makers = identity("makers")
    stranger, member = identity("stranger"), identity("member", makers)

    async def tried(who: Identity) -> int:
        async with linked(served, who) as link:
            lease = await link.call("acquire", "plc")
            await link.call("give_up", lease)
            with pytest.raises(BadUserAccessDenied):
                await link.node("State.Name").write_value("RUN")
            return lease

    async def modes() -> set[ua.MessageSecurityMode]:
        async with linked(served) as link:
            return {found.SecurityMode for found in await link.client.get_endpoints()}

    assert await modes() == {ua.MessageSecurityMode.None_, ENCRYPTED}
    assert await tried(plc) > 0
    for who in (stranger, member, makers):
        with pytest.raises(BadCertificateUntrusted):
            await tried(who)
    # The trust list counts as it is when a session begins.
    (folder / "trusted" / "makers.der").write_bytes(makers.der)
    assert await tried(member) > 0
    (folder / "trusted" / "plc.der").unlink()
    with pytest.raises(BadCertificateUntrusted):
        await tried(plc)
    (folder / "trusted" / "bad.der").write_bytes(b"no certificate")
    with pytest.raises(BadCertificateUntrusted):
        await tried(member)
    for path in (folder / "trusted").iterdir():
        path.unlink()
    with pytest.raises(BadCertificateUntrusted):
        await tried(member)


async def test_without_a_folder_the_interface_is_read_only(serve, plc) -> None:
    served = serve("opcua")

    async with linked(served) as link:
        (endpoint,) = await link.client.get_endpoints()
        assert endpoint.SecurityMode == ua.MessageSecurityMode.None_
        with pytest.raises(BadUserAccessDenied):
            await link.call("hold")
        assert await link.read("Identification.Labels") == ["ball", "box"]


# -- commands and values -----------------------------------------------------------------------


async def test_a_trusted_client_commands_and_reads_all(open_cell, plc) -> None:
    served = open_cell()
    async with linked(served, plc) as link:
        with pytest.raises(BadNoData):
            await link.read("LastAnswer.Label")
        lease = await link.call("acquire", "plc")
        await link.until("State.Commander", lambda name: name == "plc")
        await link.call("identify", lease, 1, 0.0, True, 1)
        await link.ended(1)
        now = served.service.snapshot()
        for value in VALUES:
            assert await link.read(value.node) == value.of(now), value.node
        assert await link.read("LastAnswer.Label") == await link.call("label", 1) == "ball"
        assert await link.read("Taxels") == now.status.live.counts.tolist()
        assert await link.call("release", lease) == -501  # an argument is missing
        assert served.grip_n > 1.0
        served.service.command(lease, Command.SHUTDOWN)
        await link.until("State.Name", lambda name: name == "STOPPED")
        with pytest.raises(BadNoData):
            await link.read("Taxels")


async def test_taxels_follow_at_most_ten_times_a_second(open_cell, plc) -> None:
    served = open_cell()
    frames: list[ua.DataValue] = []

    def note(_node: Any, value: Any, data: Any) -> None:
        if value is not None:
            frames.append(data.monitored_item.Value)

    async with linked(served, plc) as link:
        watch = await link.client.create_subscription(
            20, SimpleNamespace(datachange_notification=note)
        )
        await watch.subscribe_data_change(link.node("Taxels"))
        lease = await link.call("acquire", "plc")
        for job in (1, 2, 3):
            await link.call("identify", lease, 1, 0.0, False, job)
            await link.ended(job)
            async with asyncio.timeout(LIMIT_S):
                while len(frames) < job:
                    await asyncio.sleep(0.02)
        await watch.delete()
    taken_s = [frame.SourceTimestamp.timestamp() for frame in frames]
    assert len(taken_s) > 2
    assert all(b - a > 0.9 * PERIOD_S for a, b in pairwise(taken_s))


async def test_faults_refusals_and_the_end_reach_who_subscribes(serve, folder, plc) -> None:
    served = serve(serve__opcua_folder=str(folder))
    interface = OpcUaInterface(served.service)
    events: asyncio.Queue[Any] = asyncio.Queue()
    listener = SimpleNamespace(event_notification=events.put_nowait)
    own = SimpleNamespace(interfaces={"opcua_port": interface.port})
    with suppress(ConnectionError):  # the interface is closed before its client
        async with linked(own, plc) as link, asyncio.timeout(LIMIT_S):
            types = link.client.nodes.base_event_type
            kinds = [
                await types.get_child(f"{link.space}:{name}")
                for name in (FAULT_EVENT, SHUTDOWN_EVENT)
            ]
            watch = await link.client.create_subscription(20, listener)
            await watch.subscribe_events(evtypes=kinds)
            assert await link.read("LastRefusal.Number") == 0
            lease = await link.call("acquire", "plc")
            assert await link.call("release", lease, 1, 0) == -513
            await link.until("LastRefusal.Number", lambda number: number == 513)
            assert (await link.read("LastRefusal.Text")).startswith("release: 0x1 is not the key")
            assert await link.read("LastRefusal.Remedy") == "Correct the request."
            served.plugin.fail(FrameTimeout("no frame for 0.2 s"))
            event = await events.get()
            assert event.FaultNumber == served.service.status().fault_number
            assert event.FaultText == event.Message.Text == served.service.status().fault
            assert (event.Remedy.startswith("Check"), event.SourceName) == (True, "Cell")
            closing = asyncio.create_task(asyncio.to_thread(interface.close))
            event = await events.get()
            assert event.Message.Text.startswith("The program of the cell ends")
            await closing
    assert events.empty()


async def test_values_are_bad_while_the_cell_cannot_be_asked(opened, monkeypatch) -> None:

    async def bad(link: Link) -> bool:
        data = await link.node("State.Name").read_data_value(raise_on_bad_status=False)
        return data.StatusCode.value == ua.StatusCodes.BadNoCommunication

    async with linked(opened) as link, asyncio.timeout(LIMIT_S):
        monkeypatch.setattr(
            opened.service, "snapshot", raising(CellError("the process of the loop is gone"))
        )
        while not await bad(link):
            await asyncio.sleep(0.02)
        monkeypatch.undo()
        while await bad(link):
            await asyncio.sleep(0.02)
        assert await link.read("State.Name") == "IDLE"


# -- who may connect, and the folder -----------------------------------------------------------


async def test_endless_requests_are_cut_off(opened, monkeypatch) -> None:
    async def never(_connection: Any) -> None:
        """Stand for the time after which a connection without session is closed anyhow."""

    monkeypatch.setattr(OPCUAProtocol, "_activation_watchdog", never)
    address = ("127.0.0.1", opened.interfaces["opcua_port"])
    header = b"HELF" + struct.pack("<I", 2**31)
    with socket.create_connection(address, LIMIT_S) as link, suppress(ConnectionError):
        link.sendall(header)
        for _ in range(256):
            link.sendall(bytes(65536))
        assert link.recv(1) == b""

    async with linked(opened) as link:
        assert await link.read("State.Name") == "IDLE"


def test_the_folder_is_made_once_and_its_key_is_the_operators(serve, tmp_path) -> None:
    folder = tmp_path / "new" / "pki"
    served = serve("opcua", serve__opcua_folder=str(folder))
    made = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert set(made) == {"certificate.der", "key.pem"}
    assert (folder / "key.pem").stat().st_mode & 0o777 == 0o600
    busy = served.service.config.serve.model_copy(
        update={"opcua_port": served.interfaces["opcua_port"]}
    )
    served.service.config = served.service.config.model_copy(update={"serve": busy})
    with pytest.raises(CellError, match="cannot be opened"), open_interfaces(served.service):
        pass
    assert made == {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    (folder / "trusted" / "bad.pem").write_bytes(b"no certificate")
    with pytest.raises(ConfigError, match="opcua_folder"):
        OpcUaInterface(served.service)
    (folder / "trusted" / "bad.pem").unlink()
    (folder / "key.pem").unlink()
    with pytest.raises(CellError, match=r"key\.pem"), open_interfaces(served.service):
        pass
