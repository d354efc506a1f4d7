"""Addresses of network cameras as people write them, with #, @ or / in passwords, and how they may be shown."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import quote, unquote

from lumidock.errors import InputError

SCHEMES = ("rtsp", "rtsps", "rtp")
_HOST = r"(?P<host>[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.%]+\])(?::(?P<port>[0-9]{1,5}))?"
_PLACE = re.compile(rf"{_HOST}(?P<path>[/?].*)?", re.DOTALL)
_SECRET = re.compile(
    r"(?i)((?:pass(?:word|wd|phrase)?|pwd|psw|token|secret|auth|api_?key|key|credential|user(?:name)?|login)\s*[=:]\s*)[^&;/?#\s]+"
)
_HIDDEN = r"\1***"


@dataclass(frozen=True, slots=True)
class Address:
    """The parts of an address; `user` and `password` as they are meant, not as they are quoted."""

    scheme: str
    user: str
    password: str
    host: str
    port: int | None
    path: str

    @property
    def url(self) -> str:
        """The address with user and password quoted, as libraries want it."""
        login = f"{quote(self.user, safe='')}:{quote(self.password, safe='')}@" if self.user or self.password else ""
        return f"{self.scheme}://{login}{self._place}{self.path}"

    @property
    def shown(self) -> str:
        """Host, port and path, without what is secret, fit to be written down."""
        return f"{self._place}{hidden(self.path)}"

    @property
    def _place(self) -> str:
        return self.host if self.port is None else f"{self.host}:{self.port}"


def hidden(text: str) -> str:
    """A text with the values of what is called a user, password, token or key in it replaced."""
    return _SECRET.sub(_HIDDEN, text)


def address_of(text: str) -> Address:
    """The parts of scheme://[USER[:PASSWORD]@]HOST[:PORT][/PATH].

    The host begins behind the last @ that a host can follow, unless what stands before the first / is one already.
    Raises: InputError, without what is secret, where no host is named.
    """
    scheme, _, rest = text.partition("://")
    direct = _PLACE.fullmatch(rest)
    login, place = "", direct
    if direct is None or "@" in re.split(r"[/?#]", rest, maxsplit=1)[0]:
        place = None
        for at in reversed([found.start() for found in re.finditer("@", rest)]):
            place = _PLACE.fullmatch(rest, at + 1)
            if place is not None:
                login = rest[:at]
                break
    if place is None or int(place["port"] or 0) > 65535:
        raise InputError(f"{scheme}: no host in the address; wanted rtsp://HOST/PATH, rtp://HOST:PORT")
    user, _, password = login.partition(":")
    port = int(place["port"]) if place["port"] else None
    return Address(scheme, unquote(user), unquote(password), place["host"], port, place["path"] or "")
