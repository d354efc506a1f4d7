"""The wheel that an sdist of this checkout makes."""

import subprocess
import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def wheel_from_sdist(folder):
    """Build the sdist, and of what it holds the wheel, in `folder`; the wheel's path."""
    _hatch(ROOT, "sdist", folder)
    (sdist,) = folder.glob("lumidock-*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    _hatch(folder / "unpacked" / sdist.name.removesuffix(".tar.gz"), "wheel", folder)
    (wheel,) = folder.glob("lumidock-*.whl")
    return wheel


def _hatch(source, target, folder):
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
