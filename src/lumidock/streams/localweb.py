"""Which requests a server on this machine answers: none that a page of somebody else's makes in an operator's browser.

A page from elsewhere may send requests to addresses of this machine, and may give its own name an address of this
machine to read the answers (DNS rebinding). The Host of a request then is that name, or its Origin is that page.
"""

from __future__ import annotations

import socket
from ipaddress import ip_address

_OWN_NAMES = ("localhost",)


def is_answered(listening: str, host: str | None, origin: str | None) -> bool:
    """Whether a request is answered by a server that listens on the address `listening`, by its Host and Origin.

    On this machine alone the Host has to be an address of it; on the network it may be any address, since no name can
    be given to an address without a name, or this machine's own name. An Origin has to be the server's own page.
    """
    if not host:
        return False
    name = _name_of(host)
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        return False
    if name in _OWN_NAMES:
        return True
    try:
        address = ip_address(name)
    except ValueError:
        return not _is_loopback(listening) and name == socket.gethostname().lower()
    return address.is_loopback or not _is_loopback(listening)


def _name_of(host: str) -> str:
    """The Host without its port and brackets."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0].lower()


def _is_loopback(listening: str) -> bool:
    try:
        return ip_address(listening).is_loopback
    except ValueError:
        return listening in _OWN_NAMES
