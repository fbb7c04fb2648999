"""Access control for the editor's HTTP and websocket requests, by Host, Origin and a token.

The Origin header identifies requests of other sites' pages, which can reach a server on loopback. The Host header
identifies foreign names that resolve to this machine (DNS rebinding). Programs of other users of this machine can send
any header; they do not know the token. The X-Forwarded headers are not read: any client can send them, and the address
behind a reverse proxy is an option of the command.
"""

import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable
from urllib.parse import parse_qs, parse_qsl, urlencode, urlsplit

_COOKIE = "splatgraft_token"
LOOPBACK = ("127.0.0.1", "localhost", "::1")
_ADDRESS = re.compile(
    r"(https?)://([a-z0-9.-]+|\[[0-9a-f:.]+\])(?::([0-9]{1,5}))?((?:/[\w.~-]+)*)/?", re.ASCII | re.IGNORECASE
)
"""Scheme, name, port and path."""


@dataclass(frozen=True)
class AccessDecision:
    """The decision on one request."""

    allowed: bool
    """Whether the request is accepted."""
    reason: str = ""
    """Why it is refused, as a message for the user."""
    cookie: str | None = None
    """Set-Cookie header that stores the token in the browser; None: no header."""


@dataclass(frozen=True)
class PublicAddress:
    """The address under which a reverse proxy shows the editor."""

    origin: str
    """Scheme, name and port as browsers send them in the Origin header, such as https://studio.example."""
    path: str
    """Path of the start page without a slash at its end; empty at the root."""

    @property
    def name(self) -> str:
        """The name in the Host header, lower case."""
        return urlsplit(self.origin).hostname or ""

    @property
    def is_encrypted(self) -> bool:
        """Whether browsers reach it by HTTPS."""
        return self.origin.startswith("https:")


def parse_public_address(address: str) -> PublicAddress:
    """The public address that a user gives.

    Args:
        address: Such as https://studio.example/splat/.

    Raises:
        ValueError: If it is not an http or https address of plain letters without a query.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None or {".", ".."} & set(found[4].split("/")):
        raise ValueError(f"--public-url: expected an address such as https://studio.example/splat, found {address}")
    scheme, name = found[1].lower(), found[2].lower()
    # browsers leave the usual port out
    port = "" if found[3] in (None, {"http": "80", "https": "443"}[scheme]) else f":{found[3]}"
    return PublicAddress(f"{scheme}://{name}{port}", found[4])


@runtime_checkable
class HasHeaders(Protocol):
    """Headers of a request, of which one name may occur several times."""

    def get_all(self, key: str) -> list[str]:
        """All values of a header."""
        ...


def plain_headers(headers: HasHeaders) -> dict[str, str]:
    """The headers on which a decision depends; a repeated one is joined, so that it matches no accepted value."""
    found = {name: headers.get_all(name) for name in ("Host", "Origin", "Upgrade", "Cookie")}
    return {name: ("; " if name == "Cookie" else ", ").join(values) for name, values in found.items() if values}


def allowed_query(path: str) -> str | None:
    """The query with which a page is to be opened instead, with its question mark; None where it can stay.

    Only the token is allowed: viser's page takes the address of another server from its query, whose controls may
    hold scripts.

    Args:
        path: Request path with its query.
    """
    given = parse_qsl(urlsplit(path).query, keep_blank_values=True)
    allowed = [(key, value) for key, value in given if key == "token"]
    return None if allowed == given else f"?{urlencode(allowed)}"


@dataclass(frozen=True)
class AccessControl:
    """The access rules of one server."""

    token: str
    """Token that each request must carry: in the address, or as a cookie afterwards."""
    hosts: tuple[str, ...] = LOOPBACK
    """Accepted names in the Host header beside the public one; empty: any name."""
    public: PublicAddress | None = None
    """The address behind a reverse proxy; None: browsers reach the server itself."""
    is_encrypted: bool = False
    """Whether the server speaks HTTPS."""

    def __post_init__(self) -> None:
        """Check that there is a token.

        Raises:
            ValueError: If there is none.
        """
        if not self.token:
            raise ValueError("access control: expected a token, found none")

    def check(self, headers: Mapping[str, str], path: str) -> AccessDecision:
        """Decide on a request.

        Args:
            headers: Request headers, names in canonical capitalisation.
            path: Request path with its query.
        """
        refusal = self._refusal(headers)
        if refusal:
            return AccessDecision(False, refusal)
        name = cookie_name(headers.get("Host", ""))
        given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        if hmac.compare_digest(given.encode(), self.token.encode()):
            return AccessDecision(True, cookie=f"{name}={self.token}; {self._cookie_attributes()}")
        if any(hmac.compare_digest(value.encode(), self.token.encode()) for value in _cookies(headers, name)):
            return AccessDecision(True)
        return AccessDecision(False, "expected the token that `splatgraft edit` printed: open the complete address")

    def _refusal(self, headers: Mapping[str, str]) -> str:
        """Why the Host or Origin header is refused; empty where it is accepted."""
        host = headers.get("Host", "")
        names = (*self.hosts, self.public.name) if self.hosts and self.public else self.hosts
        if names and _name(host) not in names:
            return "expected the name of this machine in the address, found another"
        origin = headers.get("Origin")
        if origin is not None and not self._is_own(origin, host):
            return "expected a request of the editor's own page, found one of another site"
        if headers.get("Upgrade", "").lower() == "websocket" and origin is None:
            return "expected a websocket of a browser, with an Origin header, found none"
        return ""

    def _is_own(self, origin: str, host: str) -> bool:
        """Whether an Origin is that of the editor's own page."""
        if self.public is not None and origin.lower() == self.public.origin:
            return True
        # a page that came unencrypted under the public name is not the editor's
        is_public = self.public is not None and host.lower() == _netloc(self.public.origin)
        return not is_public and _netloc(origin) == host.lower()

    def _cookie_attributes(self) -> str:
        path = "/" if self.public is None else self.public.path or "/"
        is_encrypted = self.is_encrypted or (self.public is not None and self.public.is_encrypted)
        return f"HttpOnly; SameSite=Strict; Path={path}" + ("; Secure" if is_encrypted else "")


def _name(host: str) -> str:
    """The name in a Host header; empty where the header is malformed."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(:[0-9]+)?", host)
    return found[1].strip("[]").lower() if found else ""


def cookie_name(host: str) -> str:
    """Name of the cookie for a Host header: browsers send the cookies of all ports of a host to each of them."""
    port = re.search(r":([0-9]+)$", host)
    return f"{_COOKIE}_{port[1] if port else 'default'}"


def _cookies(headers: Mapping[str, str], name: str) -> list[str]:
    """All values of a cookie: editors under several paths of one host may each have set one."""
    pairs = (pair.strip().partition("=") for pair in headers.get("Cookie", "").split(";"))
    return [value.strip('"') for key, _, value in pairs if key == name]


def _netloc(origin: str) -> str:
    """Name and port of an Origin, lower case; empty where it is malformed."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""
