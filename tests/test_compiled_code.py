"""Compiled code on disk is of the sources beside it, lies where it can be written, and can do without a disk."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lumidock._kernels
from lumidock._kernels.lens import factor

CALLEE = """from lumidock._kernels.compiling import part


@part
def value(a):
    return a.copy()[0] * {}
"""
CALLER = """from lumidock._kernels.compiling import entry
from lumidock._kernels.callee import value


@entry
def twice(a):
    return 2.0 * value(a)
"""
ASK = """import json
import numba
import numpy as np
from lumidock._kernels import compiling
before = numba.config.CACHE_DIR
from lumidock._kernels.caller import twice
assert numba.config.CACHE_DIR == before
n = float(twice(np.ones(3)))
hits = sum(twice.stats.cache_hits.values()) if hasattr(twice, "stats") else 0
print(json.dumps([n, hits, str(compiling.FOLDER), compiling.compiled_entries()]))
"""
DETECTIONS = """import json
from bench.shipped import shipped_camera, shipped_station
from lumidock.datatypes import Detections
from lumidock.localizer import Localizer
station, camera = shipped_station(), shipped_camera()
localizer = Localizer(station, camera)
for k in range(3):
    uv = camera.project(station.p_dock * (1.0, -1.0, -1.0) + (0.0, 0.0, 9.0 - 0.02 * k))
    fix = localizer.process_detections(Detections.from_uv(str(k), k * 100_000_000, uv))
print(json.dumps([fix.status, fix.T_dock_cam.tolist()]))
"""
SEALED = "-dac_override,-dac_read_search,-fowner"  # without these, the modes of files hold for root too


@pytest.fixture
def package(tmp_path):
    """The code that compiles kernels, and two small ones."""
    kernels = tmp_path / "lumidock" / "_kernels"
    kernels.mkdir(parents=True)
    (kernels.parent / "__init__.py").touch()
    for source in ("__init__", "cache", "compiling"):
        shutil.copy(Path(lumidock._kernels.__file__).with_name(f"{source}.py"), kernels)
    (kernels / "callee.py").write_text(CALLEE.format(1))
    (kernels / "caller.py").write_text(CALLER)
    return kernels


def ask(package, *, obeys_modes=False, **environment):
    """Result, cache hits, folder and counts of a process that calls the entry and has no home."""
    clean = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "TMPDIR")}
    as_others = (
        ["setpriv", f"--bounding-set={SEALED}", f"--inh-caps={SEALED}"] if obeys_modes and os.getuid() == 0 else []
    )
    done = subprocess.run(
        [*(as_others if obeys_modes and os.getuid() == 0 else []), sys.executable, "-c", ASK],
        cwd=package.parents[1],
        env={**clean, "PYTHONDONTWRITEBYTECODE": "1", **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    n, hits, folder, counts = json.loads(done.stdout)
    return n, hits, None if folder == "None" else Path(folder), counts


@pytest.fixture
def seal(package):
    """A function that makes the package read-only, and returns a folder for temporary files."""
    if os.getuid() == 0 and not shutil.which("setpriv"):
        pytest.skip("root writes everywhere, and there is no setpriv to stop it")
    scratch = package.parents[1] / "scratch"
    scratch.mkdir()

    def done():
        for folder in (package, *(path for path in package.rglob("*") if path.is_dir())):
            folder.chmod(0o555)
        return scratch

    yield done
    for folder in (package, *(path for path in package.rglob("*") if path.is_dir())):
        folder.chmod(0o755)


def test_code_that_calls_a_changed_function_is_compiled_anew(package):
    n, hits, first, counts = ask(package)
    assert (n, hits, first.parent, counts) == (2.0, 0, package / "__pycache__", [1, 1])
    assert ask(package) == (2.0, 1, first, [1, 1])
    (package / "callee.py").write_text(CALLEE.format(21))
    n, hits, second, _ = ask(package)
    assert (n, hits) == (42.0, 0)
    assert list((package / "__pycache__").glob("compiled-*")) == [second]


def test_the_folder_that_is_asked_for_is_used_and_those_of_others_stay(package, tmp_path):
    other = tmp_path / "compiled-0123456789abcdef"
    other.mkdir()
    _, hits, folder, counts = ask(package, NUMBA_CACHE_DIR=str(tmp_path))
    assert (hits, folder.parent, counts, other.exists()) == (0, tmp_path, [1, 1], True)
    assert ask(package, NUMBA_CACHE_DIR=str(tmp_path))[1] == 1
    assert not (package / "__pycache__").exists()


def test_a_read_only_package_keeps_its_code_in_the_temporary_folder(package, seal):
    scratch = seal()
    for hits in (0, 1):
        found = ask(package, obeys_modes=True, TMPDIR=str(scratch))
        assert found[:2] == (2.0, hits)
        assert found[2].is_relative_to(scratch)
    assert found[2].parent.stat().st_mode & 0o077 == 0


def test_what_was_compiled_before_a_package_became_read_only_is_used(package, seal):
    assert ask(package)[1] == 0
    scratch = seal()
    found = ask(package, obeys_modes=True, TMPDIR=str(scratch))
    assert found[:2] == (2.0, 1)
    assert found[2].is_relative_to(scratch)


def test_the_users_own_folder_comes_before_the_temporary_one(package, seal):
    scratch = seal()
    found = ask(package, obeys_modes=True, TMPDIR=str(scratch), HOME=str(scratch))
    assert found[2].parent == scratch / ".cache" / "lumidock"


@pytest.mark.parametrize("made", ["a file", "a folder that others can write"])
def test_without_a_folder_of_its_own_it_runs_and_keeps_nothing(package, seal, made):
    scratch = seal()
    taken = scratch / f"lumidock-{os.getuid()}"
    if made == "a file":
        taken.touch()
    else:
        taken.mkdir()
        taken.chmod(0o777)
    assert ask(package, obeys_modes=True, TMPDIR=str(scratch)) == (2.0, 0, None, [0, 1])


def test_without_a_compiler_it_runs_and_keeps_nothing(package):
    assert ask(package, NUMBA_DISABLE_JIT="1") == (2.0, 0, None, [0, 1])
    assert not (package / "__pycache__").exists()


def test_without_a_compiler_detections_still_make_a_fix():
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    words = [sys.executable, "-c", DETECTIONS]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    status, T_dock_cam = json.loads(done.stdout)
    assert status == "tracking"
    expected = np.diag([1.0, -1.0, -1.0, 1.0])
    expected[2, 3] = 8.96
    np.testing.assert_allclose(T_dock_cam, expected, rtol=0.0, atol=1e-4)


def test_warm_and_doctor_say_the_same_where_nothing_can_be_kept(lumidock, monkeypatch):
    monkeypatch.setattr("lumidock._kernels.compiling.FOLDER", None)
    code, out, err = lumidock("warm")
    assert (code, out, err.count("\n")) == (2, "", 1)
    code, out, _ = lumidock("doctor", "--json")
    assert code == 1
    (found,) = (finding for finding in json.loads(out) if finding["what"] == "caches")
    assert found["mark"] == "bad"
    assert found["text"] in err
    assert "NUMBA_CACHE_DIR" in err


def test_python_can_call_a_part():
    A = np.array([[4.0, 0.0, 0.0], [2.0, 5.0, 0.0], [1.0, 3.0, 6.0]])
    expected = np.linalg.cholesky(np.tril(A) + np.tril(A, -1).T)
    factor(A, 3)
    np.testing.assert_allclose(np.tril(A), expected, rtol=0.0, atol=1e-12)
