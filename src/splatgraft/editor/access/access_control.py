"""Who may talk to the editor: the page itself, from the machine itself, or with a token. Knows no web server.

A page on another site can reach a server on loopback: its Origin gives it away. A name that was made to point here
(DNS rebinding) shows in Host.
"""

import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

COOKIE = "splatgraft_token"
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class Answer:
    """What the gate says to a request."""

    allowed: bool
    """Whether it may pass."""
    reason: str = ""
    """Why not, for the person who reads the page."""
    cookie: str | None = None
    """The Set-Cookie header that keeps the token."""


@dataclass(frozen=True)
class AccessControl:
    """The rules of one server."""

    hosts: tuple[str, ...] = LOOPBACK
    """Names under which the server may be called; empty: any, which wants a token."""
    token: str | None = None
    """What a request must know; None: nothing, on loopback alone."""

    def __post_init__(self) -> None:
        """Raises: ValueError where anyone could come in."""
        if not self.hosts and not self.token:
            raise ValueError("gate: expected a token for a server that others can reach, found none")

    def ask(self, headers: Mapping[str, str], path: str) -> Answer:
        """Whether a request with these headers may pass; header names in their usual capitals."""
        stranger = self._stranger(headers)
        if stranger or self.token is None:
            return Answer(not stranger, stranger)
        given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        if hmac.compare_digest(given.encode(), self.token.encode()):
            return Answer(True, cookie=f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/")
        if hmac.compare_digest(_cookie(headers).encode(), self.token.encode()):
            return Answer(True)
        return Answer(False, "expected the token that `splatgraft edit` printed: open the whole address it gave")

    def _stranger(self, headers: Mapping[str, str]) -> str:
        """What shows that a request is not the page's own; nothing where it is."""
        host = headers.get("Host", "")
        if self.hosts and _name(host) not in self.hosts:
            return "expected to be called by the name of this machine"
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return "expected a request of the editor's own page, found one of another site"
        if headers.get("Upgrade", "").lower() == "websocket" and origin is None:
            return "expected a browser, which names the page that it talks for"
        return ""


def _name(host: str) -> str:
    """The name in a Host header; nothing where it is no honest one."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(:[0-9]+)?", host)
    return found[1].strip("[]").lower() if found else ""


def _cookie(headers: Mapping[str, str]) -> str:
    try:
        found = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""
