"""How kernels are compiled: an entry is called from Python and kept on disk, a part is compiled into its entries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.extending import register_jitable

from lumidock._kernels import cache

F = TypeVar("F", bound=Callable[..., Any])

_config: Any = numba.config  # its names are not in its types

DISABLED = bool(_config.DISABLE_JIT)
"""Whether kernels run uncompiled, as NUMBA_DISABLE_JIT demands."""
FOLDER: Path | None = None if DISABLED else cache.choose(cache.digest())
"""Where compiled code is kept; None where no folder can be written."""
if FOLDER is not None:
    cache.remove_outdated(FOLDER)

ENTRIES: list[Callable[..., Any]] = []
"""All entries of the modules that were imported so far."""


def entry(function: F) -> F:
    """A kernel that Python calls; its machine code, parts included, is kept on disk."""
    before = _config.CACHE_DIR  # is read when a function is decorated, and other libraries have theirs
    _config.CACHE_DIR = str(FOLDER or "")
    try:
        compiled = cast(F, numba.njit(error_model="numpy", cache=FOLDER is not None)(function))
    finally:
        _config.CACHE_DIR = before
    ENTRIES.append(compiled)
    return compiled


def part(function: F) -> F:
    """A kernel that other kernels call. Python runs it uncompiled: numba need not make it callable from there."""
    return register_jitable(error_model="numpy")(function)


def fast_part(function: F) -> F:
    """A `part` whose sums may be added up in any order and fused with products: several additions run at once."""
    return register_jitable(error_model="numpy", fastmath={"reassoc", "contract"})(function)


def compiled_entries(without: tuple[str, ...] = ()) -> tuple[int, int]:
    """How many of `ENTRIES` are on disk, and how many there are, leaving out those of some modules."""
    named = [(one.__module__.rpartition(".")[2], one.__name__) for one in ENTRIES]
    asked = {f"{module}.{name}" for module, name in named if module not in without}
    found = FOLDER.rglob("*.nbi") if FOLDER is not None else ()
    return len(asked & {path.name.split("-")[0] for path in found}), len(asked)  # module.function-line.python.nbi
