"""Access control for the editor's HTTP and websocket requests, by Host, Origin and a token.

The Origin header identifies requests of other sites' pages, which can reach a server on loopback. The Host header
identifies foreign names that resolve to this machine (DNS rebinding). Programs of other users of this machine can send
any header; they do not know the token.
"""

import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

_COOKIE = "splatgraft_token"
LOOPBACK = ("127.0.0.1", "localhost", "::1")


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
class AccessControl:
    """The access rules of one server."""

    token: str
    """Token that each request must carry: in the address, or as a cookie afterwards."""
    hosts: tuple[str, ...] = LOOPBACK
    """Accepted names in the Host header; empty: any name."""

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
            return AccessDecision(True, cookie=f"{name}={self.token}; HttpOnly; SameSite=Strict; Path=/")
        if hmac.compare_digest(_cookie(headers, name).encode(), self.token.encode()):
            return AccessDecision(True)
        return AccessDecision(False, "expected the token that `splatgraft edit` printed: open the complete address")

    def _refusal(self, headers: Mapping[str, str]) -> str:
        """Why the Host or Origin header is refused; empty where it is accepted."""
        host = headers.get("Host", "")
        if self.hosts and _name(host) not in self.hosts:
            return "expected the name of this machine in the address, found another"
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return "expected a request of the editor's own page, found one of another site"
        if headers.get("Upgrade", "").lower() == "websocket" and origin is None:
            return "expected a websocket of a browser, with an Origin header, found none"
        return ""


def _name(host: str) -> str:
    """The name in a Host header; empty where the header is malformed."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(:[0-9]+)?", host)
    return found[1].strip("[]").lower() if found else ""


def cookie_name(host: str) -> str:
    """Name of the cookie for a Host header: browsers send the cookies of all ports of a host to each of them."""
    port = re.search(r":([0-9]+)$", host)
    return f"{_COOKIE}_{port[1] if port else 'default'}"


def _cookie(headers: Mapping[str, str], name: str) -> str:
    try:
        found = SimpleCookie(headers.get("Cookie", "")).get(name)
    except CookieError:
        return ""
    return found.value if found else ""
