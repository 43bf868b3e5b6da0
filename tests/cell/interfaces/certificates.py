"""Certificates of OPC UA's clients, and a folder that trusts one; needs the extra opcua."""

from pathlib import Path
from typing import Any, NamedTuple

from asyncua.crypto import cert_gen, uacrypto
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID


class Identity(NamedTuple):
    """A client's certificate and key."""

    certificate: x509.Certificate
    key: Any

    @property
    def der(self) -> bytes:
        return uacrypto.der_from_x509(self.certificate)

    @property
    def pem(self) -> bytes:
        """The key."""
        return cert_gen.dump_private_key_as_pem(self.key)


def identity(name: str, signer: Identity | None = None, days: int = 1) -> Identity:
    """Return a new certificate: self-signed, or of a signer."""
    key = cert_gen.generate_private_key()
    names = [x509.UniformResourceIdentifier(f"urn:{name}")]
    use = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if signer is None:
        return Identity(
            cert_gen.generate_self_signed_app_certificate(key, name, {}, names, use, days), key
        )
    request = cert_gen.generate_app_certificate_signing_request(key, name, {}, names, use)
    return Identity(
        cert_gen.sign_certificate_request(request, signer.certificate, signer.key, days), key
    )


def trusting(folder: Path, plc: Identity) -> Path:
    (folder / "trusted").mkdir()
    (folder / "trusted" / "plc.der").write_bytes(plc.der)
    (folder / "trusted" / "README.txt").write_text("clients that may command")
    return folder
