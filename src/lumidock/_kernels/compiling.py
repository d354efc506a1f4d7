"""How kernels are compiled and kept: those that Python calls are whole programs, all others are parts of these.

Numba optimises a function anew in each of its callers and theirs, makes machine code of every one, stores all of it in
a form that others could take in, and imports whatever compiling may ask for before it loads any. Here a part is left as
it was lowered and optimised where it ends up, and of an entry the machine code alone is stored and loaded.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, TypeVar, cast

from llvmlite import binding
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]

F = TypeVar("F", bound=Callable[..., Any])


def entry(function: F) -> F:
    """A kernel that Python calls and no other kernel does; compiled once and kept on disk."""
    dispatcher = compiled(function)
    dispatcher._cache = _Kept(function)
    return cast(F, dispatcher)


def part(function: F) -> F:
    """A kernel that other kernels call; for Python it is a TypeError."""
    return cast(F, compiled(function, pipeline_class=PartCompiler))


def fast_part(function: F) -> F:
    """A `part` whose sums may be taken in any order and fused with products."""
    return cast(F, compiled(function, pipeline_class=PartCompiler, fastmath={"reassoc", "contract"}))


def compiled(function: F, **options: Any) -> Any:  # noqa: ANN401
    """With the same options for all: where they differ, numba compiles what it has itself once for each."""
    options["no_cfunc_wrapper"] = True
    return njit(error_model="numpy", **options)(function)


class _MachineCode(CompileResultCacheImpl):
    """What is stored of an entry: its machine code, and under which names Python finds it there."""

    def reduce(self, result: object) -> object:
        """All but bitcode, types and the globals of the functions inside, which are for linking and printing."""
        (name, kind, (code, _)), described, *rest, _, reload, _ = super().reduce(result)
        names = described.llvm_cpython_wrapper_name, described.env_name
        defined = binding.parse_assembly("".join(f'@"{symbol}" = global i8 0\n' for symbol in names))
        return (name, kind, (code, defined.as_bitcode())), described, *rest, "", reload, ()


class _Kept(FunctionCache):
    """The code on disk, which is loaded without numba's compiler: that takes as long to import as all the rest."""

    _impl_class = _MachineCode

    def load_overload(self, sig: object, target_context: object) -> object:
        """Load the code for a signature; None where there is none."""
        for name, address in _nrt_python.c_helpers.items():  # what code calls to allocate
            binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)
        return None


class _Part(JITCodeLibrary):
    """Code to link into others, which is never loaded by itself."""

    _refuse = ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value  # raises TypeError

    def finalize(self) -> None:
        """Take in what it calls."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int | None:  # noqa: ARG002
        """What a call from Python ends in."""
        self._ensure_finalized()
        return self._refuse

    @property
    def codegen(self) -> _Part:
        """Who is told of the function's environment."""
        return self

    def set_env(self, env_name: str, env: object) -> None:
        """Code that is not loaded has no place for one."""


class PartCompiler(Compiler):
    """Numba's compiler, into a `_Part`."""

    def define_pipelines(self) -> object:
        """The usual passes."""
        self.state.flags.no_cpython_wrapper = True
        self.state.library = _Part(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()
