"""Compiled code on disk is of the sources beside it, those of other files included, and runs without the compiler."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lumidock._kernels
from lumidock._kernels.lens import factor

CALLEE = "from lumidock._kernels.compiling import part\n\n\n@part\ndef value(a):\n    return a.copy()[0] * {}\n"
CALLER = """from lumidock._kernels.compiling import entry
from kernels.callee import value


@entry
def twice(a):
    return 2.0 * value(a)
"""
ASK = """import sys
import numpy as np
from kernels.caller import twice
n, hits = twice(np.ones(3)), sum(twice.stats.cache_hits.values())
print(n, hits, "numba.np.arrayobj" in sys.modules, twice(np.ones(3, np.float32)))
"""


def ask(folder):
    done = subprocess.run([sys.executable, "-c", ASK], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_code_that_calls_a_changed_function_is_compiled_anew(tmp_path):
    package = tmp_path / "kernels"
    package.mkdir()
    shutil.copy(Path(lumidock._kernels.__file__), package / "__init__.py")
    (package / "callee.py").write_text(CALLEE.format(1))
    (package / "caller.py").write_text(CALLER)
    assert ask(tmp_path) == ["2.0", "0", "True", "2.0"]
    assert ask(tmp_path) == ["2.0", "1", "False", "2.0"]
    (package / "callee.py").write_text(CALLEE.format(21))
    assert ask(tmp_path) == ["42.0", "0", "True", "42.0"]


def test_python_cannot_call_what_is_only_a_part_of_other_kernels():
    with pytest.raises(TypeError):
        factor(np.eye(3), 3)
