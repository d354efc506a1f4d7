"""What runs on the vehicle has wheels for Linux on aarch64, in the locked versions."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import tomllib

ROOT = Path(__file__).parents[1]
VEHICLE = ("bag", "video", "mavlink", "zenoh", "live", "console")
PLATFORMS = ("manylinux_2_34_aarch64", "manylinux_2_28_aarch64", "manylinux2014_aarch64")
PIN = re.compile(r"^([A-Za-z0-9._-]+)==(\S+)(?: ; (.+?))? \\$", re.MULTILINE)


@pytest.mark.peers
def test_core_and_vehicle_extras_resolve_for_aarch64(tmp_path):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(requirement for name in VEHICLE for requirement in extras[name])]
    pins = PIN.findall((ROOT / "requirements.lock").read_text())
    lines = [f"{name}=={version}{' ; ' * bool(marker)}{marker}" for name, version, marker in pins]
    (tmp_path / "pins.txt").write_text("\n".join(lines))
    platforms = [word for platform in PLATFORMS for word in ("--platform", platform)]
    how = ["--dry-run", "--ignore-installed", "--only-binary=:all:", "--target", str(tmp_path), *platforms]
    python = ["--implementation", "cp", "--python-version", "3.11"]
    command = [sys.executable, "-m", "pip", "install", *how, *python, "-c", str(tmp_path / "pins.txt"), *wanted]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    for name in ("numpy", "opencv-python-headless", "rosbags", "av", "pymavlink", "eclipse-zenoh", "foxglove-sdk"):
        assert name in done.stdout.replace("_", "-")
