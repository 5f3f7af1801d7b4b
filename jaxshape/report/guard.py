"""The live view answers only requests of its own page, at one of its own addresses.

In a browser, a page from any site can send requests to 127.0.0.1, too. The name of the machine in a
request (`Host`) and the page that asks (`Origin`) tell such requests from those of the view. [host]
"""

import ipaddress
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio import server  # pyright: ignore[reportMissingImports] - of viser

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def is_own(hosts: Sequence[str], origins: Sequence[str], served: str) -> bool:
    """Whether a request comes from the page of the view itself.

    Args:
        hosts: All headers `Host` of the request.
        origins: All headers `Origin` of the request; none where no page asks.
        served: Address at which the view listens.

    Returns:
        True where the request names one host, by an address or a name of this machine, and the page
        that asks, if any, came from that host.
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    host = hosts[0].lower()
    if any(origin.lower() not in (f"http://{host}", f"https://{host}") for origin in origins):
        return False
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    if served in LOOPBACK:
        return name in LOOPBACK
    return name in (*LOOPBACK, served.lower(), *_own_names()) or _is_address(name)


def _own_names() -> tuple[str, ...]:
    return socket.gethostname().lower(), socket.getfqdn().lower()


def _is_address(name: str) -> bool:
    """Whether a host is given as an IP address, which a foreign host name cannot imitate."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextmanager
def guarded(served: str) -> Iterator[None]:
    """Let a server that viser starts in the block refuse requests from other pages.

    Viser has no option for this. It passes its request handler to `websockets`; there the handler
    is wrapped.

    Args:
        served: Address at which the view listens.

    Raises:
        RuntimeError: Viser started its server in another way, and is not guarded.
    """
    serve, guards = server.serve, []

    def guarded_serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def answered(connection: Any, request: Any) -> Any:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            if not is_own(hosts, origins, served):
                return connection.respond(HTTPStatus.FORBIDDEN, "Ask at the address of the view.\n")
            return process_request(connection, request)

        guards.append(answered)
        return serve(*arguments, process_request=answered, **options)

    server.serve = guarded_serve
    try:
        yield
    finally:
        server.serve = serve
    if not guards:
        raise RuntimeError(
            "jaxshape cannot filter the requests to this version of viser; install another version."
        )
