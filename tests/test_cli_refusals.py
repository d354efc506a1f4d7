"""What the command line cannot do is one line and exit code 2, and harms nothing."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from commandline import PAPER, contents, fixes, start
from test_run import simulate, stamps
from test_sources import write_video


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["dance"], "No such command"),
        (["--dance"], "No such option"),
        (["run"], "SOURCE"),
        (["run", "x"], "--out"),
        (["run", "x", "--out"], "--out"),
        (["run", "x", "--out", "y", "--fsp", "3"], "No such option"),
        (["run", "x", "--out", "y", "--fps", "fast"], "--fps"),
        (["sim", "approach", "--out", "y", "--seed", "-1"], "--seed"),
        (["sim", "approach", "--out", "y", "--seed", "1.5"], "--seed"),
        (["eval", "x"], "x: no such folder"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, list) else None,
)
def test_wrong_words_are_one_line(refusal, words, match):
    assert match in refusal(*words)


# Runs that cannot start


def edit(name, old, new):
    """Replace text in a file of the sequence, once."""

    def change(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def write(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def remove(name):
    return lambda folder: (folder / name).unlink()


def add_layers(folder):
    edit("station.yaml", "layer: front", "layer: middle")(folder)
    edit("station.yaml", "layer: front", "layer: rear")(folder)


SPOILT = {
    "no source": (shutil.rmtree, "no such file or folder"),
    "empty source": (lambda folder: [path.unlink() for path in folder.iterdir()], "neither timestamps.csv nor"),
    "missing column": (edit("timestamps.csv", "t_ns", "time"), "no column t_ns"),
    "empty table": (write("timestamps.csv", b""), "no column frame"),
    "no rows": (write("timestamps.csv", b"frame,file,t_ns\n"), "no frames"),
    "no columns of detections": (write("detections.csv", b"a,b\n"), "no column frame"),
    "no station": (remove("station.yaml"), "give --station"),
    "no camera": (remove("camera.yaml"), "give --camera"),
    "light twice": (edit("station.yaml", "id: B", "id: A"), "light id A given twice"),
    "light not finite": (edit("station.yaml", "- 0.9\n", "- .nan\n"), "finite number"),
    "unknown key": (edit("station.yaml", "name: small", "name: small\nnome: small"), "nome: unknown key"),
    "wrong schema": (edit("station.yaml", "schema: 1", "schema: 2"), "schema"),
    "three layers": (add_layers, "at most two"),
    "station that is no text": (write("station.yaml", bytes(range(256))), "not valid YAML"),
    "camera that is no camera": (write("camera.yaml", b"a: 1\n"), "camera.yaml: no calibration"),
}
WRONG_OPTIONS = [
    ("--station", "cage", "cage: No such file"),
    ("--station", ".", "not a file"),
    ("--camera", "none.yaml", "none.yaml: No such file"),
    ("--method", "dance", "--method dance"),
    ("--fps", "0", "frame rate"),
    ("--fps", "nan", "frame rate"),
    ("--config", "none.yaml", "none.yaml: No such file"),
    ("--config", "unknown.yaml", "paper.pso.particle: unknown key"),
    ("--config", "wrong.yaml", "paper.pso.particles: "),
]


@pytest.fixture
def not_started(refusal, sequence, earlier):
    """Check that a run over the sequence is refused and neither harms an earlier run nor leaves a folder."""

    def check(match, *words):
        before = contents(earlier)
        assert match in refusal("run", sequence, *PAPER, *words, "--out", earlier, "--force")
        assert contents(earlier) == before
        assert match in refusal("run", sequence, *PAPER, *words, "--out", earlier.with_name("new"))
        assert not earlier.with_name("new").exists()

    return check


@pytest.mark.parametrize(("spoil", "match"), SPOILT.values(), ids=SPOILT)
def test_a_spoilt_source_is_one_line_and_harms_nothing(not_started, sequence, spoil, match):
    spoil(sequence)
    not_started(match)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["sim:nowhere"], "no such scenario"),
        (["sim:"], "no such scenario"),
        (["sim:approach", "--method", "dance"], "--method dance"),
        (["sim:approach", "--config", "none.yaml"], "none.yaml: No such file"),
        (["sim:approach", "--station", "none.yaml"], "none.yaml: No such file"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, list) else None,
)
def test_a_run_that_cannot_start_simulates_nothing(refusal, tmp_path, words, match):
    assert match in refusal("run", *words, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("option", "value", "match"), WRONG_OPTIONS, ids=lambda word: str(word))
def test_a_wrong_option_is_one_line_and_harms_nothing(not_started, monkeypatch, tmp_path, option, value, match):
    monkeypatch.chdir(tmp_path)
    Path("unknown.yaml").write_text("paper: {pso: {particle: 3}}\n")
    Path("wrong.yaml").write_text("paper: {pso: {particles: 0}}\n")
    not_started(match, option, value)


def test_an_image_folder_needs_a_frame_rate(refusal, tmp_path):
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((4, 4), np.uint8))
    assert "--fps" in refusal("run", tmp_path / "images", "--out", tmp_path / "run")


@pytest.mark.parametrize("content", [b"", b"not a video", None], ids=["empty", "text", "cut"])
def test_a_broken_video_is_one_line(tmp_path, content):
    write_video(tmp_path / "dive.mp4")
    content = (tmp_path / "dive.mp4").read_bytes()[:-100] if content is None else content
    (tmp_path / "dive.mp4").write_bytes(content)
    process = start("run", tmp_path / "dive.mp4", "--out", tmp_path / "run")
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out) == (2, "")
    assert err == f"lumidock: {tmp_path / 'dive.mp4'}: not a video that can be decoded\n"


@pytest.mark.parametrize("spoil", [b"", b"text", None], ids=["empty", "text", "huge"])
def test_a_run_without_a_usable_row_is_one_line(refusal, tmp_path, sequence, spoil):
    (sequence / "detections.csv").unlink()
    (sequence / "frames").mkdir()
    stamps(sequence, lambda rows: [row.__setitem__(1, "a.png") for row in rows])
    if spoil is None:
        spoil = cv2.imencode(".png", np.zeros((300, 400), np.uint8))[1].tobytes()
    (sequence / "frames" / "a.png").write_bytes(spoil)
    refusal("run", sequence, *PAPER, "--out", tmp_path / "run")
    assert [row["reason"] for row in fixes(tmp_path / "run")] == ["bad_frame"] * 7


def test_a_folder_that_cannot_be_made_is_one_line(refusal, bare, tmp_path):
    tmp_path.chmod(0o555)
    folder = Path("/proc") if os.geteuid() == 0 else tmp_path  # root may write anywhere else
    assert str(folder / "run") in refusal("run", bare, *PAPER, "--out", folder / "run")


def test_the_source_is_not_written_into(refusal, sequence):
    before = contents(sequence)
    assert "is the source" in refusal("run", sequence, *PAPER, "--station", "cage-2x2x5", "--out", sequence, "--force")
    assert contents(sequence) == before


# Simulation


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["nowhere"], "no such scenario; there are any-roll, approach"),
        (["aproach"], "no such scenario, did you mean approach? There are any-roll, approach"),
        (["nowhere.yaml"], "nowhere.yaml: No such file"),
        (["trials", "--set", "path"], "wanted key=value"),
        (["trials", "--set", "=1"], "wanted key=value"),
        (["trials", "--set", "path.speed=1"], "path.speed: unknown key"),
        (["trials", "--set", "path.speed_m_s=fast"], "path.speed_m_s: "),
        (["trials", "--set", "path.speed_m_s=-1"], "path.speed_m_s: "),
        (["trials", "--set", "path.start_z_m=.nan"], "path.start_z_m: "),
        (["trials", "--set", "path=[1"], "not valid YAML"),
        (["trials", "--station", "nowhere"], "nowhere: No such file"),
        (["trials", "--camera", "nowhere"], "nowhere: No such file"),
        (["trials", "--video", "--detections"], "have no pictures"),
        (["flat-port", "--detections"], "which bare detections do not model; render it"),
        (["trials", "--video", "--set", "output.pixels=mono16", "--set", "output.file=png"], "not mono16"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, list) else None,
)
def test_a_simulation_that_cannot_start_touches_nothing(refusal, sequence, words, match):
    before = contents(sequence)
    assert match in refusal("sim", *words, "--out", sequence, "--force")
    assert contents(sequence) == before


# Evaluation


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["none", "SEQUENCE"], "none: no such folder"),
        (["SEQUENCE", "SEQUENCE"], "sequence: neither a run nor a folder with runs"),
        (["RUN", "RUN"], "earlier/truth.csv: No such file"),
        (["RUN", "none"], "none: No such file"),
        (["RUN", "RUN/fixes.csv"], "earlier/fixes.csv: "),
        (["RUN", "SLOWER"], "another sequence"),
    ],
    ids="-".join,
)
def test_an_evaluation_of_the_wrong_folders_is_one_line(refusal, sequence, earlier, tmp_path, words, match):
    if words[1].startswith("RUN/"):
        (earlier / "fixes.csv").write_text("frame\n")
    if words[1] == "SLOWER":
        simulate(tmp_path / "slower", "path.frame_interval_s=0.4", bare=True)
    names = {"SEQUENCE": str(sequence), "RUN": str(earlier), "SLOWER": str(tmp_path / "slower")}
    full = [names.get(word.split("/")[0], word) + word[len(word.split("/")[0]) :] for word in words]
    assert match in refusal("eval", *full)
