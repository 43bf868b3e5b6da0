"""The server of OPC UA: asyncua with rights to connect, read and call.

A client that may connect can read without certificate. Methods need an encrypted channel
(SignAndEncrypt) and a client certificate in the trust list. No variable can be written. Plain
asyncua lets any client call methods, has an administrator without password, trusts a certificate
that is only named on a plain channel, and gives sessions guessable numbers. `Clients`, `Session`,
`Sessions` and `UnencryptedPolicy` prevent this.
"""

import logging
import secrets
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto import cert_gen, uacrypto
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.security_policies import SecurityPolicyFactory
from asyncua.crypto.truststore import TrustStore
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.ua import SecurityPolicyType, StatusCodes
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from cell.config.serve import ServeConfig
from cell.interfaces.access import BUSY_MAX, ConnectionPlaces, may_connect, notice_dead_peers

_LONGEST_BYTES = 1 << 20
"""Largest request in bytes."""
VALID_DAYS = 3650
"""Validity in days of a certificate made here; every client must trust a new certificate again."""
ENCRYPTED = (
    SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
)
"""Policies of channels for commands."""
for _name in ("asyncua", "asyncuagds"):
    logging.getLogger(_name).addHandler(logging.NullHandler())  # no log lines on the console


class Clients:
    """Users: client certificates of the trust list, a folder; None: no user is trusted."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._trusted: TrustStore | None = None

    async def load(self) -> None:
        """Read the present trust list. Raises ValueError for a file without a certificate."""
        found = None
        try:
            files = () if self._folder is None else self._folder.iterdir()
            if any(file.suffix in (".der", ".pem") for file in files):
                store = TrustStore([self._folder], [])
                await store.load()
                found = store
        finally:
            self._trusted = found

    def get_user(self, _server: Any, certificate: bytes | None = None, **_password: Any) -> User:
        """Return the user of a certificate whose key was proven when the channel was opened."""
        if not certificate:
            return User(role=UserRole.User)
        found = uacrypto.x509_from_der(certificate)
        if self._trusted is None or not self._trusted.is_trusted(found):
            raise ServiceError(StatusCodes.BadCertificateUntrusted)
        return User(role=UserRole.User, name=found.subject.rfc4514_string() or "a client")


class Session(InternalSession):
    """A session: it reads, and calls methods if its user has a name."""

    async def create_session(self, params: Any, sockname: Any = None) -> Any:
        """Create the session with the present trust list."""
        with suppress(ValueError, OSError):  # no user is trusted then
            await self.iserver.user_manager.load()
        return await super().create_session(params, sockname)

    async def call(self, params: Any) -> Any:
        """Call methods."""
        if self.user.name is None:
            raise ServiceError(StatusCodes.BadUserAccessDenied)
        return await super().call(params)


class Sessions(InternalServer):
    """The internal server of all connections; its session numbers cannot be guessed."""

    def __init__(self, clients: Clients, config: ServeConfig) -> None:
        super().__init__(user_manager=clients)
        self.config = config
        self.allow_remote_admin = False
        self.supported_tokens = (ua.AnonymousIdentityToken,)
        # `ConnectionPlaces` has the limit: surplus connections are closing, and many may come
        # before they are gone.
        self.max_connections = 100 * BUSY_MAX
        self.max_subscriptions = BUSY_MAX
        self.max_pending_activation_seconds = config.request_timeout_s
        self.places = ConnectionPlaces()
        self.max_monitored_item_queue_size = 100  # 10 s of taxels
        self.max_session_timeout_ms = 60_000  # then a silent session is closed

    def create_session(
        self, name: str, user: User | None = None, external: bool = False
    ) -> Session:
        """Return a session whose user has no rights before its activation."""
        return Session(self, self.aspace, self.subscription_service, name, user or User(), external)

    def register_external_session(self, session: InternalSession) -> None:
        """Register a session with a random token, which lets its client change the connection."""
        session.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
        super().register_external_session(session)

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse registrations: this is no discovery server."""
        raise ServiceError(StatusCodes.BadServiceUnsupported)


class UnencryptedPolicy(SecurityPolicyFactory):
    """Channels without security: their certificates prove nothing and are ignored."""

    def create(self, peer_certificate: bytes | None) -> Any:
        """Return a policy without certificate of the client."""
        return super().create(None)


class OpcUaConnection(OPCUAProtocol):
    """A connection from a host of the allow-list, with requests of limited size."""

    def connection_made(self, transport: Any) -> None:
        """Begin, or close a connection from another host."""
        host = (transport.get_extra_info("peername") or ("",))[0]
        if may_connect(host, self.iserver.config):
            notice_dead_peers(transport.get_extra_info("socket"))
            super().connection_made(transport)
            self.iserver.places.enter(transport, host)
        else:
            transport.close()

    def data_received(self, data: bytes) -> None:
        """Take bytes; close if a request is too long."""
        super().data_received(data)
        session = self.processor.session if self.processor is not None else None
        if session is not None and session.is_activated():
            self.iserver.places.heard(self.transport)
        if len(self._buffer) > _LONGEST_BYTES:
            self.transport.close()


class Listener(BinaryServer):
    """The listening socket."""

    def _make_protocol(self) -> OpcUaConnection:
        tasks = self.closing_tasks
        return OpcUaConnection(self.iserver, self._policies, self.clients, tasks, self.limits)


class CellServer(Server):
    """The server with the sessions and connections of this module."""

    def __init__(self, sessions: Sessions) -> None:
        super().__init__(sessions)
        self.application_type = ua.ApplicationType.Server
        self.set_server_name("tactile-cell")
        self.set_endpoint("opc.tcp://localhost/")  # clients get the address that they used
        self.set_security_policy([SecurityPolicyType.NoSecurity])

    async def start(self) -> None:
        """Listen. Raises OSError if it cannot."""
        config = self.iserver.config
        limits = TransportLimits(
            max_message_size=_LONGEST_BYTES, max_chunk_count=_LONGEST_BYTES // 8192
        )
        await self._setup_server_nodes()
        plain, *encrypted = self._policies
        self.bserver = Listener(self.iserver, config.listen, config.opcua_port or 0, limits)
        self.bserver.set_policies([UnencryptedPolicy(plain.cls, plain.mode), *encrypted])
        await self.bserver.start()
        await self.iserver.start()

    async def use_certificate(self, folder: Path) -> None:
        """Load certificate.der and key.pem of a folder; create both if both are missing."""
        certificate, key = folder / "certificate.der", folder / "key.pem"
        if not certificate.exists() and not key.exists():
            host, secret = socket.gethostname(), cert_gen.generate_private_key()
            names = [x509.UniformResourceIdentifier(f"urn:{host}:tactile-cell"), x509.DNSName(host)]
            made = cert_gen.generate_self_signed_app_certificate(
                secret, "tactile-cell", {}, names, [ExtendedKeyUsageOID.SERVER_AUTH], VALID_DAYS
            )
            key.touch(mode=0o600)
            key.write_bytes(cert_gen.dump_private_key_as_pem(secret))
            certificate.write_bytes(uacrypto.der_from_x509(made))
        await self.load_certificate(certificate)
        await self.load_private_key(key)
        extensions = self.iserver.certificate.extensions
        found = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        (uri,) = found.get_values_for_type(x509.UniformResourceIdentifier)
        await self.set_application_uri(uri)
        self.set_security_policy([SecurityPolicyType.NoSecurity, *ENCRYPTED])
