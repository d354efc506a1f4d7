"""What the command line writes into, and what it leaves alone."""

import os
from pathlib import Path

import pytest
from commandline import PAPER, PLAIN, contents, fixes, start


def test_an_existing_folder_needs_force(refusal, lumidock, bare, earlier):
    before = contents(earlier)
    assert "--force" in refusal("run", bare, *PAPER, "--out", earlier)
    assert contents(earlier) == before
    (earlier / "notes.txt").write_text("mine")
    (earlier / "fixes.csv").write_text("old")
    assert lumidock("run", bare, *PAPER, "--out", earlier, "--force")[0] == 0
    assert (earlier / "notes.txt").read_text() == "mine"
    assert len(fixes(earlier)) == 7


@pytest.mark.parametrize(
    "command", [["run", "SOURCE", *PAPER], ["sim", "trials", "--detections"], ["demo"]], ids="-".join
)
@pytest.mark.parametrize("force", [[], ["--force"]], ids=["", "force"])
def test_a_file_in_place_of_the_folder_is_kept(refusal, bare, tmp_path, command, force):
    (tmp_path / "file").write_text("mine")
    words = [bare if word == "SOURCE" else word for word in command]
    assert "is a file" in refusal(*words, "--out", tmp_path / "file", *force)
    assert "Not a directory" in refusal(*words, "--out", tmp_path / "file" / "deeper", *force)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_runs_own_files_can_be_used_again(lumidock, bare, earlier):
    before = contents(earlier)
    files = ("--station", earlier / "station.yaml", "--camera", earlier / "camera.yaml")
    assert lumidock("run", bare, *PAPER, *files, "--out", earlier, "--force")[0] == 0
    for name in map(Path, ("station.yaml", "camera.yaml", "trajectory.tum")):
        assert contents(earlier)[name] == before[name]


def test_a_links_target_is_not_overwritten(lumidock, bare, earlier, tmp_path):
    (tmp_path / "mine.yaml").write_text("mine")
    (earlier / "station.yaml").unlink()
    (earlier / "station.yaml").symlink_to(tmp_path / "mine.yaml")
    assert lumidock("run", bare, *PAPER, "--out", earlier, "--force")[0] == 0
    assert (tmp_path / "mine.yaml").read_text() == "mine"
    assert (earlier / "station.yaml").read_bytes() == (bare / "station.yaml").read_bytes()


def test_any_folder_name_can_be_told(bare, tmp_path):
    strict = PLAIN | {"PYTHONIOENCODING": "utf-8:strict"}
    process = start("run", bare, *PAPER, "--out", os.fsencode(tmp_path) + b"/\xff", text=False, env=strict)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (0, b"")
    assert b"7 frames" in out


def test_a_simulated_sequence_can_be_replaced(lumidock, sequence):
    (sequence / "frames").mkdir()
    (sequence / "frames" / "stale.jpg").touch()
    (sequence / "notes.txt").write_text("mine")
    assert lumidock("sim", "trials", "--detections", "--out", sequence, "--force")[0] == 0
    assert not (sequence / "frames").exists()
    assert (sequence / "notes.txt").read_text() == "mine"
    assert len((sequence / "truth.csv").read_text().splitlines()) == 77


@pytest.mark.parametrize("name", ["frames/a.jpg", "timestamps.csv", "camera.yaml", "detections.csv"])
@pytest.mark.parametrize("command", [("sim", "trials", "--detections"), ("sim", "approach")], ids="-".join)
def test_frames_that_were_not_simulated_are_never_replaced(refusal, tmp_path, command, name):
    (tmp_path / "real" / name).parent.mkdir(parents=True)
    (tmp_path / "real" / name).write_text("mine")
    assert "was not simulated" in refusal(*command, "--out", tmp_path / "real", "--force")
    assert contents(tmp_path / "real") == {Path(name): b"mine"}


def test_a_link_to_frames_is_removed_and_not_the_frames(lumidock, sequence, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "a.jpg").write_text("mine")
    (sequence / "frames").symlink_to(tmp_path / "disk")
    assert lumidock("sim", "trials", "--detections", "--out", sequence, "--force")[0] == 0
    assert (tmp_path / "disk" / "a.jpg").read_text() == "mine"
