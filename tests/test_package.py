"""What a user installs: the wheel that the sdist makes, outside the checkout."""

import os
import subprocess
import sysconfig
import venv
import zipfile

import pytest
from package import ROOT, wheel_from_sdist

APPROACH = ("path.start_z_m=6", "path.end_z_m=5.8", "path.frame_interval_s=0.1")
SMALL_CAMERA = """\
image_width: 306
image_height: 256
camera_name: small
camera_matrix: {rows: 3, cols: 3, data: [265, 0, 152.5, 0, 265, 127.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return wheel_from_sdist(tmp_path_factory.mktemp("package"))


@pytest.fixture(scope="module")
def lumidock(wheel, tmp_path_factory):
    """The command in an environment that has the wheel and, of the environment of the tests, the libraries."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, with_pip=False)
    packages = folder / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    # compiling would take minutes; a small picture can do without
    env = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "HOME"}}
    env["NUMBA_DISABLE_JIT"] = "1"

    def call(*words):
        command = [folder / "bin" / "python", "-m", "lumidock", *words]
        done = subprocess.run([*map(str, command)], cwd=folder, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return call


def test_the_wheel_holds_every_file_of_the_package(wheel):
    package = ROOT / "src" / "lumidock"
    here = {path for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if name.startswith("lumidock/")}
    assert names == {str(path.relative_to(package.parent)) for path in here}


def test_the_installed_wheel_simulates_and_runs(lumidock, tmp_path):
    (tmp_path / "camera.yaml").write_text(SMALL_CAMERA)
    settings = [word for setting in APPROACH for word in ("--set", setting)]
    lumidock("sim", "approach", *settings, "--camera", tmp_path / "camera.yaml", "--out", tmp_path / "sequence")
    text = lumidock("run", tmp_path / "sequence", "--out", tmp_path / "run")
    assert "3 frames: 2 valid" in text  # one frame alone is not proven
