"""`make compat`: the wheel does its work in clean environments, on every Python at hand.

Each Python gets the newest versions that pyproject.toml allows; the lowest Python also gets the lowest. Each
environment is read-only, belongs to somebody else, and has no HOME.
Arguments choose some: `python tests/compat.py 3.13 3.10-lowest`.
"""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from package import ROOT, wheel_from_sdist

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
NOBODY = "65534"
APPROACH = ("path.start_z_m=9.5", "path.end_z_m=8.3", "path.frame_interval_s=0.2")
FRAMES = 7
LOWEST = "lowest"


def main():
    """Exit code 1 when an environment falls short."""
    wanted = set(sys.argv[1:])
    pythons = {version: python for version in PYTHONS if (python := python_of(version))}
    kinds = [(version, "newest") for version in pythons] + [(min(pythons, key=PYTHONS.index), LOWEST)]
    chosen = [kind for kind in kinds if not wanted or wanted & {*kind, "-".join(kind)}]
    print(f"Python {', '.join(pythons)} at hand", flush=True)
    failed = 0
    with tempfile.TemporaryDirectory(prefix="lumidock-compat-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        wheel = wheel_from_sdist(folder)
        for version, kind in chosen:
            start = time.monotonic()
            try:
                result = proved(pythons[version], wheel, folder / f"{version}-{kind}", lowest=kind == LOWEST)
            except (AssertionError, subprocess.TimeoutExpired) as error:
                failed += 1
                result = f"FAILED: {error}"
            print(f"{version}, {kind} versions, {time.monotonic() - start:.0f} s: {result}", flush=True)
    sys.exit(1 if failed or not chosen else 0)


def python_of(version):
    """An interpreter of that version that runs: of pyenv, or on PATH."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [*sorted(pyenv.glob(f"{version}.*/bin/python{version}")), shutil.which(f"python{version}")]
    for python in filter(None, found):
        done = subprocess.run([python, "-c", "import ensurepip, venv"], capture_output=True, check=False)
        if done.returncode == 0:
            return str(python)
    return None


def proved(python, wheel, folder, *, lowest):
    """Install the wheel and let it work; what was installed."""
    env, work = folder / "env", folder / "work"
    work.mkdir(parents=True)
    constraints = folder / "constraints.txt"
    constraints.write_text("\n".join(lowest_versions()) if lowest else "")
    said([python, "-m", "venv", str(env)])
    install = [str(env / "bin" / "python"), "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    said([*install, "-c", str(constraints), str(wheel)])
    freeze = [str(env / "bin" / "python"), "-m", "pip", "freeze", "--disable-pip-version-check"]
    versions = [line.split(" @ ")[0] for line in said(freeze).split()]
    said(["chmod", "-R", "a+rX,a-w", str(env)])
    if os.getuid() == 0:
        said(["chown", "-R", NOBODY, str(work)])
    worked(env / "bin" / "lumidock", work)
    return ", ".join(sorted(line for line in versions if re.match("numpy|opencv|numba|pydantic|typer|rich", line)))


def lowest_versions():
    """A constraint for each lower bound in pyproject.toml: the series that it begins."""
    text = (ROOT / "pyproject.toml").read_text()
    core = re.search(r"^dependencies = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)[1]
    found = re.findall(r'"([A-Za-z0-9-]+)>=([0-9.]+)', core)
    assert len(found) == core.count('"') // 2, "a dependency without a lower bound"
    return [f"{name}=={bound}.*" for name, bound in found]


def worked(lumidock, work):
    """The main job as a user who owns nothing of the installation and has no HOME."""
    temporary = work / "tmp"
    alone = []
    if os.getuid() == 0:
        said(["install", "-d", "-o", NOBODY, "-g", NOBODY, str(temporary)])
        # it may read everything, since the interpreter may lie in root's home, and write nothing but its own
        capability = ["--inh-caps", "+dac_read_search", "--ambient-caps", "+dac_read_search"]
        alone = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", *capability]
    else:
        temporary.mkdir()
    env = {"PATH": os.defpath, "LANG": "C.UTF-8", "TMPDIR": str(temporary)}

    def call(*words, codes=(0,)):
        return said([*alone, str(lumidock), *words], cwd=work, env=env, codes=codes)

    settings = [word for setting in APPROACH for word in ("--set", setting)]
    call("sim", "approach", "--seed", "3", *settings, "--out", "sequence")
    assert len(list((work / "sequence" / "frames").iterdir())) == FRAMES, "sim: frames are missing"
    call("run", "sequence", "--out", "run")
    with (work / "run" / "fixes.csv").open(newline="") as file:
        valid = [row["valid"] for row in csv.DictReader(file)]
    assert valid.count("1") >= FRAMES - 1, f"run: valid {valid}"
    counts = json.loads(call("eval", "run", "sequence", "--json"))
    assert counts["frames"] == FRAMES, f"eval: {counts['frames']} frames"
    assert counts["hazardous"]["valid"]["any"] == 0, "eval: hazardous poses"
    call("warm")
    marks = {one["what"]: one["mark"] for one in json.loads(call("doctor", "--json", codes=(0, 1)))}
    assert {marks[what] for what in ("Python", "lumidock", "OpenCV", "numpy", "caches")} == {"ok"}, f"doctor: {marks}"
    call("demo")
    assert (work / "demo-out" / "run" / "fixes.csv").exists(), "demo: no run"


def said(command, *, codes=(0,), **options):
    """Standard output of a command that succeeds."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=3600, check=False, **options)
    last = (done.stderr or done.stdout).strip()[-2000:]
    assert done.returncode in codes, f"{' '.join(map(str, command[-8:]))}: exit code {done.returncode}\n{last}"
    return done.stdout


if __name__ == "__main__":
    main()
