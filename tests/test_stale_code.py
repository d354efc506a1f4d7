"""Compiled code on disk is of the sources beside it, those of other files included."""

import shutil
import subprocess
import sys
from pathlib import Path

import lumidock._kernels

CALLEE = "from numba import njit\n\n\n@njit(cache=True)\ndef value():\n    return {}\n"
CALLER = """from numba import njit
from kernels.callee import value


@njit(cache=True)
def twice():
    return 2 * value()
"""
ASK = "from kernels.caller import twice; n = twice(); print(n, sum(twice.stats.cache_hits.values()))"


def ask(folder):
    done = subprocess.run([sys.executable, "-c", ASK], cwd=folder, capture_output=True, text=True, check=True)
    return [int(word) for word in done.stdout.split()]


def test_code_that_calls_a_changed_function_is_compiled_anew(tmp_path):
    package = tmp_path / "kernels"
    package.mkdir()
    shutil.copy(Path(lumidock._kernels.__file__), package / "__init__.py")
    (package / "callee.py").write_text(CALLEE.format(1))
    (package / "caller.py").write_text(CALLER)
    assert ask(tmp_path) == [2, 0]
    assert ask(tmp_path) == [2, 1]
    (package / "callee.py").write_text(CALLEE.format(21))
    assert ask(tmp_path) == [42, 0]
