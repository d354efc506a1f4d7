"""Which requests a server on this machine answers: none that a page of somebody else's makes in an operator's browser.

A page from elsewhere may send requests to addresses of this machine, and may give its own name an address of this
machine to read the answers (DNS rebinding). The Host of a request then is that name, or its Origin is that page.
"""

from __future__ import annotations

import socket
from ipaddress import ip_address

_OWN_NAME = "localhost"


def is_loopback(listening: str) -> bool:
    """Whether an address to listen on is this machine's own."""
    try:
        return ip_address(listening).is_loopback
    except ValueError:
        return listening == _OWN_NAME


def is_known_host(listening: str, host: str) -> bool:
    """Whether the Host of a request is one of a server that listens on the address `listening`.

    On this machine alone it has to be an address of it; on the network it may be any address, since no name can be
    given to an address without a name, or this machine's own name.
    """
    name = _name_of(host)
    if name in (_OWN_NAME, listening):
        return True
    try:
        address = ip_address(name)
    except ValueError:
        own = socket.gethostname().lower()
        return not is_loopback(listening) and name in (own, f"{own}.local")
    return address.is_loopback or not is_loopback(listening)


def is_own_origin(host: str, origin: str | None) -> bool:
    """Whether a request comes from the server's own page, or from no page: its Origin is its Host, or not there."""
    return origin is None or origin in (f"http://{host}", f"https://{host}")


def _name_of(host: str) -> str:
    """The Host without its port and brackets."""
    if host.startswith("["):
        return host[1:].partition("]")[0] if "]" in host else ""
    return host.partition(":")[0].lower()
