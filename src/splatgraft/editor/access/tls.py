"""The certificate of a server that speaks HTTPS."""

import ssl
from pathlib import Path

_OTHER_KEY = "KEY_VALUES_MISMATCH"


def read_certificate(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """The settings of a server with a certificate; None where neither file is given.

    Args:
        certificate: The certificate, with those of its issuers behind it, in PEM.
        key: Its private key in PEM, without a password; may be in the same file.

    Raises:
        ValueError: If one of the two is missing, is not what it should be, or they do not belong together.
    """
    if certificate is None and key is None:
        return None
    for path, option, other in ((certificate, "certificate", "key"), (key, "key", "certificate")):
        if path is None:
            raise ValueError(f"--tls-{other}: expected also --tls-{option}, found none")
    assert certificate is not None
    assert key is not None
    for path, what in ((certificate, "CERTIFICATE"), (key, "PRIVATE KEY")):
        text = _text(path)
        if f"{what}-----" not in text:
            raise ValueError(f"{path}: expected a PEM file with a {what.lower()}, found none in it")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(certificate)
    except ssl.SSLError as error:
        raise ValueError(f"{certificate}: expected a certificate that can be read, found {error}") from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # without this function OpenSSL would ask for a password at the terminal
        context.load_cert_chain(certificate, key, password=_no_password)
    except ssl.SSLError as error:
        if error.reason == _OTHER_KEY:
            raise ValueError(f"{key}: expected the private key of {certificate}, found another key") from None
        raise ValueError(f"{key}: expected a private key that can be read, found {error}") from None
    return context


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode("ascii", "replace")
    except OSError as error:
        raise ValueError(f"{path}: expected a readable file, found {error.strerror}") from None


def _no_password() -> str:
    raise ValueError("--tls-key: expected a key without a password, found an encrypted one")
