"""The hot loops: plain arrays in, plain arrays out, compiled by numba.

Numba keeps compiled code by the file that a function stands in, with the code of other files that it calls inside: when
one of these changes, it is stale. So whatever was compiled from other sources is removed before it can be used.
"""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numba import njit

P = ParamSpec("P")
T = TypeVar("T")


def constant(value: int) -> int:
    """A number in numpy's type: numba compiles a function, and all below it, anew for every literal int it is given."""
    return cast(int, np.int64(value))


# of what only kernels call: it makes no arrays, so that numba need not count who holds one, and Python needs no way in;
# this halves the time it takes to compile, and a call costs a few nanoseconds
_INNER: dict[str, Any] = {"error_model": "numpy", "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


_OUTER: dict[str, Any] = {"error_model": "numpy", "_nrt": False, "cache": True}


def outer(function: Callable[P, T]) -> Callable[P, T]:
    """Compile what Python calls, and keep it on disk; it can make no arrays either."""
    return cast(Callable[P, T], njit(**_OUTER)(function))


def inner(function: Callable[P, T]) -> Callable[P, T]:
    """Compile what only kernels call; it can make no arrays."""
    return cast(Callable[P, T], njit(**_INNER)(function))


def inlined(function: Callable[P, T]) -> Callable[P, T]:
    """The same for what is smaller than a call."""
    return cast(Callable[P, T], njit(**_INNER | {"forceinline": True})(function))


def summing(function: Callable[P, T]) -> Callable[P, T]:
    """The same for loops whose sums may be added up in any order, so that many are taken at once."""
    return cast(Callable[P, T], njit(**_INNER | {"fastmath": {"reassoc", "contract"}})(function))


@njit(cache=True)
def _anything() -> None:
    """Asked only where numba keeps the code of this folder."""


def _remove_stale() -> None:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    if (folder := _anything.stats.cache_path) is None:
        return
    cache = Path(folder)
    mark = cache / "sources.sha256"
    if mark.is_file() and mark.read_text(encoding="ascii") == digest.hexdigest():
        return
    for path in cache.glob("*.nb[ci]"):
        path.unlink(missing_ok=True)
    cache.mkdir(parents=True, exist_ok=True)
    mark.write_text(digest.hexdigest(), encoding="ascii")


with suppress(OSError):  # another process may be doing the same; numba itself looks for a folder that can be written
    _remove_stale()
