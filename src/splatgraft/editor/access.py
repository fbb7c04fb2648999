"""Access control for the editor's HTTP and websocket requests, by Host, Origin and a token.

The Origin header identifies requests of other sites' pages, which can reach a server on loopback. The Host header
identifies foreign names that resolve to this machine (DNS rebinding). Programs of other users of this machine can send
any header; they do not know the token.
"""

import hmac
import re

from starlette.requests import HTTPConnection

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def why_refused(token: str, request: HTTPConnection) -> str | None:
    """Return the reason for refusing a request, as a message for the user; None if it is accepted.

    Each request must carry the token, in the address or as a cookie. A websocket must have an Origin header.
    """
    # repeated headers are joined, because the result matches no accepted value
    host, origins = ", ".join(request.headers.getlist("host")), request.headers.getlist("origin")
    if _name(host) not in LOOPBACK:
        return "expected the name of this machine in the address, found another"
    pages = [origin.lower().partition("://")[2] for origin in origins]
    if (origins or request.scope["type"] == "websocket") and pages != [host.lower()]:
        return "expected a request of the editor's own page, found one of another site"
    given = (request.cookies.get(cookie_name(host), ""), request.query_params.get("token", ""))
    if any(hmac.compare_digest(value.encode(), token.encode()) for value in given):
        return None
    return "expected the token that `splatgraft edit` printed: open the complete address"


def cookie_name(host: str) -> str:
    """Name the cookie for a Host header, with its port, because browsers share cookies between ports."""
    port = re.search(r":([0-9]+)$", host)
    return f"splatgraft_token_{port[1] if port else 'default'}"


def _name(host: str) -> str:
    """Return the name in a Host header; empty if the header is malformed."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(:[0-9]+)?", host)
    return found[1].strip("[]").lower() if found else ""
