"""What `run` and `serve` say of calibrations, and that a start that fails harms nobody."""

import json
import shutil
import socket

import numpy as np
import pytest
from commandline import PAPER, quiet, start

from lumidock.camera import Camera, load_camera, save_camera
from lumidock.errors import InputError
from lumidock.station import load_station
from lumidock.streams.run_folder import RunFolder


def another(sequence, path, *, scale=1.0, center=1.0, distortion=(0.0,) * 5):
    camera = load_camera(sequence / "camera.yaml")
    K = camera.K * np.array([[scale], [scale], [1.0]])
    K[:2, 2] = camera.center_px * center
    save_camera(Camera(camera.width, camera.height, K, "plumb_bob", np.array(distortion)), path)
    return path


def test_a_run_says_what_the_check_knows(lumidock, bare, tmp_path):
    dry = another(bare, tmp_path / "dry.yaml", distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
    code, _, err = lumidock("run", bare, *PAPER, "--camera", dry, "--out", tmp_path / "run")
    assert (code, err.count("\n")) == (0, 1)
    assert "warning: looks like made in air" in err
    checked = json.loads(lumidock("calib", "check", dry, "--json")[1])
    assert err == f"lumidock: warning: {checked['warnings'][0]}\n"
    assert quiet(lumidock("run", bare, *PAPER, "--out", tmp_path / "own")[2])


@pytest.mark.parametrize(("scale", "center"), [(1.0, 0.5), (1.0, 0.7), (0.01, 1.0), (100.0, 1.0)])
def test_an_impossible_calibration_is_refused_unless_it_is_trusted(lumidock, refusal, bare, tmp_path, scale, center):
    camera = another(bare, tmp_path / "camera.yaml", scale=scale, center=center)
    words = ("run", bare, *PAPER, "--camera", camera, "--out", tmp_path / "run")
    assert "--trust-calibration" in refusal(*words)
    assert not (tmp_path / "run").exists()
    assert lumidock(*words, "--trust-calibration")[0] in (0, 2)  # 2: with it no frame can be used
    assert "IMPOSSIBLE" in lumidock("calib", "check", camera)[1]


def test_files_in_each_other_s_place_are_named(refusal, bare, tmp_path):
    camera, station = bare / "camera.yaml", bare / "station.yaml"
    words = ("run", bare, *PAPER, "--out", tmp_path / "run")
    assert "a station file, given as the camera; it belongs to --station" in refusal(*words, "--camera", station)
    assert "a camera file, given as the station; it belongs to --camera" in refusal(*words, "--station", camera)
    assert not (tmp_path / "run").exists()


def test_a_calibration_of_another_tool_is_used_as_it_is(lumidock, bare, tmp_path):
    chain = tmp_path / "camchain.yaml"
    assert lumidock("calib", "export", bare / "camera.yaml", chain, "--to", "kalibr")[0] == 0
    assert lumidock("run", bare, *PAPER, "--camera", chain, "--out", tmp_path / "run")[0] == 0
    assert lumidock("run", bare, *PAPER, "--out", tmp_path / "own")[0] == 0
    kept = load_camera(tmp_path / "run" / "camera.yaml")
    assert np.array_equal(kept.K, load_camera(bare / "camera.yaml").K)
    rows = [(tmp_path / name / "trajectory.tum").read_bytes() for name in ("run", "own")]
    assert rows[0] == rows[1]


def test_a_folder_that_is_written_to_is_left_alone(lumidock, refusal, bare, tmp_path):
    ids = load_station(bare / "station.yaml").ids
    with RunFolder(tmp_path / "run", ids):
        before = {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()}
        line = refusal("run", bare, *PAPER, "--out", tmp_path / "run", "--force")
        assert "another process is writing a run there" in line
        with pytest.raises(InputError, match="another process"):
            RunFolder(tmp_path / "run", ids)
        assert {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()} == before
    assert lumidock("run", bare, *PAPER, "--out", tmp_path / "run", "--force")[0] == 0


def test_a_server_that_cannot_start_leaves_an_earlier_run_alone(bare, earlier, tmp_path):
    run = shutil.copytree(earlier, tmp_path / "kept")
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        process = start("serve", str(bare), *PAPER, "--out", str(run), "--force", "--health-port", port)
        _, err = process.communicate(timeout=120)
    assert (process.returncode, "cannot listen" in err) == (2, True)
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


def test_a_delay_is_taken_off_the_stamps_of_a_run(lumidock, bare, tmp_path):
    for name, words in (("own", ()), ("late", ("--delay-ms", "40"))):
        assert lumidock("run", bare, *PAPER, *words, "--out", tmp_path / name)[0] == 0
    stamps = [
        [int(line.split(",")[1]) for line in (tmp_path / name / "fixes.csv").read_text().splitlines()[1:]]
        for name in ("own", "late")
    ]
    assert [a - b for a, b in zip(*stamps, strict=True)] == [40_000_000] * len(stamps[0])
