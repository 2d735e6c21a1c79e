"""The first checks of a request: malformed paths, unknown hosts, pages of other origins."""

import ipaddress
from functools import lru_cache
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Scope, Send

from rayfix_service.http.access.paths import is_odd, is_open
from rayfix_service.http.headers import header
from rayfix_service.http.problems import FORBIDDEN, MISDIRECTED, NOT_FOUND, ProblemError, error_response

LOOPBACK_NAMES = ("localhost", "localhost.localdomain", "ip6-localhost")
"""Names of this machine for itself; addresses need no names."""

_DEFAULT_PORTS = {"http": ":80", "https": ":443", "ws": ":80", "wss": ":443"}


class Edge:
    """Middleware that refuses requests that no regular client sends.

    A browser sends requests for any page that it shows. Where keys are asked for, a page of another origin has none; a
    service without keys takes the browser for one of its machine, so the page's origin and the name by which it calls
    the service are looked at. An open web socket is no subject to the browser's own rules, so its origin is always
    looked at. What no browser sends has no ``Origin``, and is let through.

    Parameters
    ----------
    app : ASGI application
    hosts : tuple of str
        Names by which a service without keys may be called, besides loopback addresses; empty where any will do.
    origins : tuple of str
        Origins whose pages may call besides the service's own; ``*`` stands for all.
    asks_for_keys : bool
    """

    def __init__(self, app: ASGIApp, *, hosts: tuple[str, ...], origins: tuple[str, ...], asks_for_keys: bool) -> None:
        self._app = app
        self._hosts = frozenset(() if asks_for_keys else (name.lower() for name in hosts))
        self._origins = frozenset(origin.lower() for origin in origins)
        self._asks_for_keys = asks_for_keys
        self._may_be_called = lru_cache(maxsize=256)(self._is_host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] in ("http", "websocket"):
            try:
                self._check(scope)
            except ProblemError as error:
                await error_response(error)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _check(self, scope: Scope) -> None:
        if is_odd(scope["path"]):
            raise ProblemError(
                NOT_FOUND,
                "there is nothing at a path with a control character, a backslash, an empty segment, '.' or '..'; "
                "/docs lists what there is",
            )
        needs_origin = scope["type"] == "websocket" or not (self._asks_for_keys or is_open(scope["path"]))
        if not needs_origin and not self._hosts:
            return
        origin = site = None
        for name, value in scope["headers"]:
            if name == b"host":
                if self._hosts and not self._may_be_called(value):
                    raise ProblemError(
                        MISDIRECTED,
                        f"the service is not called {value[:100].decode('latin-1')!r}; call it by its address, or "
                        "start it with --allowed-host NAME",
                    )
            elif name == b"origin":
                origin = value.decode("latin-1")
            elif name == b"sec-fetch-site":
                site = value
        if needs_origin and not (origin is None and site is None):
            self._check_origin(scope, origin, site)

    def _check_origin(self, scope: Scope, origin: str | None, site: bytes | None) -> None:
        if origin is None:
            # A page may have a browser fetch pictures or post forms without naming its origin; following a link
            # only reads.
            looks = scope.get("method") in ("GET", "HEAD") and header(scope, b"sec-fetch-mode") == "navigate"
            fits = looks or site not in (b"cross-site", b"same-site")
        else:
            fits = site == b"same-origin" or is_same_origin(origin, header(scope, b"host") or "")
            fits = fits or bool(self._origins & {"*", origin.lower()})
        if fits:
            return
        raise ProblemError(
            FORBIDDEN,
            f"pages of {'another origin' if origin is None else repr(origin[:100])} may not call this service; "
            "start it with --cors-origin ORIGIN if they should",
        )

    def _is_host(self, value: bytes) -> bool:
        name = _without_port(value.decode("latin-1").strip().lower()).rstrip(".")
        if name in self._hosts or name in LOOPBACK_NAMES:
            return True
        try:
            return ipaddress.ip_address(name.strip("[]")).is_loopback
        except ValueError:
            return False


@lru_cache(maxsize=256)
def is_same_origin(origin: str, host: str) -> bool:
    """Tell whether a page of an origin comes from the host that a request is sent to.

    The scheme is left aside: a proxy that ends TLS changes it.
    """
    try:
        parts = urlsplit(origin.lower())
    except ValueError:
        return False
    port = _DEFAULT_PORTS.get(parts.scheme, "")
    return bool(parts.netloc) and parts.netloc.removesuffix(port) == host.lower().removesuffix(port)


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdecimal() and (":" not in name or name.endswith("]")) else host
