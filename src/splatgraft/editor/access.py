"""Access control for the editor's HTTP and websocket requests, by Host, Origin and a token.

The Origin header identifies requests of other sites' pages, which can reach a server on loopback. The Host header
identifies foreign names that resolve to this machine (DNS rebinding). Programs of other users of this machine can send
any header; they do not know the token.
"""

import hmac
import re
from collections.abc import Mapping
from urllib.parse import parse_qs, parse_qsl, urlencode, urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def why_refused(token: str, headers: Mapping[str, str], path: str) -> str | None:
    """Return the reason for refusing a request, as a message for the user; None if it is accepted.

    Args:
        token: Token that each request must carry, in the address or as a cookie.
        headers: Request headers, names in canonical capitalisation; a repeated header is joined by commas.
        path: Request path with its query.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if _name(host) not in LOOPBACK:
        return "expected the name of this machine in the address, found another"
    if origin is not None and origin.lower().partition("://")[2] != host.lower():
        return "expected a request of the editor's own page, found one of another site"
    if headers.get("Upgrade", "").lower() == "websocket" and origin is None:
        return "expected a websocket of a browser, with an Origin header, found none"
    pairs = (pair.strip().partition("=") for pair in headers.get("Cookie", "").split(";"))
    given = [value.strip('"') for key, _, value in pairs if key == cookie_name(host)]
    given += parse_qs(urlsplit(path).query).get("token", [])[:1]
    if any(hmac.compare_digest(value.encode(), token.encode()) for value in given):
        return None
    return "expected the token that `splatgraft edit` printed: open the complete address"


def cookie_name(host: str) -> str:
    """Name the cookie for a Host header, with its port, because browsers share cookies between ports."""
    port = re.search(r":([0-9]+)$", host)
    return f"splatgraft_token_{port[1] if port else 'default'}"


def allowed_query(path: str) -> str | None:
    """Return the query to redirect to, with its question mark; None if the query of this path is allowed.

    Only the token is allowed, because a link must not set anything else.
    """
    given = parse_qsl(urlsplit(path).query, keep_blank_values=True)
    allowed = [(key, value) for key, value in given if key == "token"]
    return None if allowed == given else f"?{urlencode(allowed)}"


def _name(host: str) -> str:
    """Return the name in a Host header; empty if the header is malformed."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(:[0-9]+)?", host)
    return found[1].strip("[]").lower() if found else ""
