"""The structure of src: no import circle, short functions, named records, libraries by their public interface only."""

import ast
import sys
from functools import cache
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"
FILES = sorted((SRC / "lumidock").rglob("*.py"))
MAX_POSITIONAL, MAX_LINES = 6, 60
INTERNAL = {"numba.core"}  # what a library's documentation calls internal although its name does not show it
OF_A_NAMED_TUPLE = {"_replace", "_asdict", "_fields", "_make"}  # public: Python's documentation lists them


def name_of(path):
    parts = path.relative_to(SRC).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in FILES}


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(tree):
    """Modules of lumidock that a file imports, inside functions and for type checking too."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (alias.name for alias in names if alias.name in MODULES)
            case ast.ImportFrom(module=str(module), names=names) if module in MODULES:
                for alias in names:
                    full = f"{module}.{alias.name}"
                    yield full if full in MODULES else module


def circles(graph):
    """Strongly connected components of more than one module, and modules that import themselves."""

    @cache
    def reach(start):
        seen, todo = set(), list(graph[start])
        while todo:
            if (module := todo.pop()) not in seen:
                seen.add(module)
                todo.extend(graph[module])
        return frozenset(seen)

    return sorted({tuple(sorted(b for b in reach(a) if a in reach(b))) for a in graph if a in reach(a)})


def long_calls(tree):
    """Line and number of arguments of each call with too many positional arguments."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and len(node.args) > MAX_POSITIONAL:
            yield node.lineno, len(node.args)


def long_functions(tree):
    """Line, name and length of each function that is too long."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = node.end_lineno - node.lineno + 1
            if lines > MAX_LINES:
                yield node.lineno, node.name, lines


def is_private(name):
    return name.startswith("_") and not name.endswith("__")


def is_internal(module):
    return any(is_private(part) for part in module.split(".")) or any(
        module == name or module.startswith(f"{name}.") for name in INTERNAL
    )


@cache
def own_private_names():
    """Private names that lumidock defines itself."""
    found = set()
    for path in FILES:
        for node in ast.walk(tree_of(path)):
            match node:
                case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                    found.add(name)
                case ast.Name(id=name, ctx=ast.Store()):
                    found.add(name)
                case ast.Attribute(value=ast.Name(id="self" | "cls"), attr=name, ctx=ast.Store()):
                    found.add(name)
    return {name for name in found if is_private(name)}


def libraries_of(tree):
    """Names under which a file knows foreign modules, and the modules."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if not alias.name.startswith("lumidock"):
                    yield alias.asname or alias.name.split(".")[0], alias.name.split(".")[0]


def dotted(node):
    """`a.b.c` of an attribute of names, else nothing."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=value, attr=attr):
            return f"{found}.{attr}" if (found := dotted(value)) else ""
    return ""


def private_names(tree):
    """Line and name of what belongs to a library and is not for others."""
    libraries = dict(libraries_of(tree))
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                for alias in names:
                    if is_internal(alias.name) and not alias.name.startswith("lumidock"):
                        yield node.lineno, alias.name
            case ast.ImportFrom(module=str(module), names=names) if not module.startswith("lumidock"):
                for alias in names:
                    if is_internal(f"{module}.{alias.name}"):
                        yield node.lineno, f"{module}.{alias.name}"
            case ast.Attribute(attr=attr):
                if (root := dotted(node).split(".")[0]) in libraries:
                    full = dotted(node).replace(root, libraries[root], 1)
                    if is_internal(full) and libraries[root] not in sys.stdlib_module_names:
                        yield node.lineno, full
                elif is_private(attr) and attr not in own_private_names() | OF_A_NAMED_TUPLE:
                    yield node.lineno, attr


def test_no_import_circle():
    graph = {module: set(imported(tree_of(path))) for module, path in MODULES.items()}
    assert circles(graph) == []


def offences(rule, files):
    return [f"{path.relative_to(SRC)}:{': '.join(map(str, found))}" for path in files for found in rule(tree_of(path))]


def test_calls_pass_few_positional_arguments():
    # compiled functions take plain values; options of a command are arguments
    files = [path for path in FILES if not {"_kernels", "cli"} & set(path.parts)]
    assert offences(long_calls, files) == []


def test_functions_are_short():
    assert offences(long_functions, FILES) == []


def test_libraries_are_used_by_their_public_interface():
    assert offences(private_names, FILES) == []


def test_the_vocabulary_is_tested():
    assert (Path(__file__).parent / "test_vocabulary.py").exists()


@pytest.mark.parametrize(
    ("graph", "found"),
    [
        ({"a": {"b"}, "b": {"c"}, "c": set()}, []),
        ({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}, [("a", "b", "c")]),
        ({"a": {"a"}}, [("a",)]),
    ],
)
def test_a_circle_is_found(graph, found):
    assert circles(graph) == found


@pytest.mark.parametrize(
    "text",
    [
        "from numba.core import types",
        "import numba\nnumba.core.registry",
        "import numba as nb\nnb._helperlib",
        "from scipy.optimize import _minimize",
        "import scipy._lib",
        "def f(dispatcher): return dispatcher._cache_hidden_in_a_library",
    ],
)
def test_a_private_name_is_found(text):
    assert list(private_names(ast.parse(text)))


@pytest.mark.parametrize(
    "text", ["import numpy as np\nnp.linalg.norm", "from __future__ import annotations", "a.__name__"]
)
def test_a_public_name_is_left_alone(text):
    assert not list(private_names(ast.parse(text)))


def test_a_long_call_and_a_long_function_are_found():
    assert list(long_calls(ast.parse("f(1, 2, 3, 4, 5, 6, 7)"))) == [(1, 7)]
    assert not list(long_calls(ast.parse("f(1, 2, 3, 4, 5, 6, seven=7)")))
    body = "\n".join(["    pass"] * MAX_LINES)
    assert list(long_functions(ast.parse(f"def f():\n{body}"))) == [(1, "f", MAX_LINES + 1)]
