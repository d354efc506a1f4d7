"""The hot loops: plain arrays in, plain arrays out, compiled by numba.

Numba keeps compiled code by the file that a function stands in, with the code of other files that it calls inside: when
one of these changes, it is stale. So whatever was compiled from other sources is removed before it can be used.
"""

import hashlib
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np
from numba import njit

from lumidock._kernels.compiling import F, PartCompiler, compiled


def constant(value: int) -> int:
    """A number in numpy's type: numba compiles a function, and all below it, anew for every literal int it is given."""
    return cast(int, np.int64(value))


def inner(function: F) -> F:
    """A `part` that makes no arrays, so that numba need not count who holds one."""
    return cast(F, compiled(function, pipeline_class=PartCompiler, _nrt=False))


def inlined(function: F) -> F:
    """The same for what is smaller than a call."""
    return cast(F, compiled(function, pipeline_class=PartCompiler, _nrt=False, forceinline=True))


def summing(function: F) -> F:
    """The same for loops whose sums may be added up in any order, so that many are taken at once."""
    return cast(F, compiled(function, pipeline_class=PartCompiler, _nrt=False, fastmath={"reassoc", "contract"}))


@njit(cache=True)
def _anything() -> None:
    """Asked only where numba keeps the code of this folder."""


def _remove_stale() -> None:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
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
