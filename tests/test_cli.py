import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from test_run import CAMERA, SETTINGS, STATION, simulate, stamps
from test_sources import write_video

from lumidock import cli
from lumidock.camera import save_camera
from lumidock.datatypes import Fix, Guide, Protection
from lumidock.sim.scenario import shipped_scenarios

LUMIDOCK = str(Path(sys.executable).with_name("lumidock"))
PLAIN = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
COMMANDS = ("run", "sim", "eval", "demo", "warm")
PAPER = ("--method", "paper")
SET = [word for setting in SETTINGS for word in ("--set", setting)]


@pytest.fixture
def refusal(lumidock):
    """Run the command line where it must refuse; returns its one line."""

    def call(*words):
        code, out, err = lumidock(*words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith("lumidock: ")
        return err

    return call


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("bare"), bare=True)


@pytest.fixture
def sequence(bare, tmp_path):
    """A sequence of bare detections that a test may spoil."""
    return shutil.copytree(bare, tmp_path / "sequence")


@pytest.fixture
def earlier(lumidock, bare, tmp_path):
    """An earlier run."""
    assert lumidock("run", bare, *PAPER, "--out", tmp_path / "earlier")[0] == 0
    return tmp_path / "earlier"


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fixes(folder):
    with (folder / "fixes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def start(*words, **options):
    """The command line in a process of its own, with a process group of its own."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen([LUMIDOCK, *words], **(pipes | {"env": PLAIN} | options))


def wait_for(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


# Help and usage


def test_without_words_there_is_help(lumidock):
    assert lumidock() == lumidock("--help")
    code, out, err = lumidock()
    assert (code, err) == (0, "")
    assert all(f"  {command} " in out for command in COMMANDS)
    assert "..." not in out.split("Commands:")[1]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(lumidock, command):
    code, out, err = lumidock(command, "--help")
    assert (code, err) == (0, "")
    assert f"Usage: lumidock {command}" in out
    assert max(map(len, out.splitlines())) <= 80


def test_help_names_every_shipped_scenario(lumidock):
    words = "".join(lumidock("sim", "--help")[1].split())  # lines break at hyphens too
    assert all(name in words for name in shipped_scenarios())


def test_the_version_is_printed_and_nothing_else_done(lumidock):
    code, out, err = lumidock("--version", "run")
    assert (code, err) == (0, "")
    assert out.strip().replace(".", "").isdigit()


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["dance"], "No such command"),
        (["--dance"], "No such option"),
        (["run"], "SOURCE"),
        (["run", "x"], "--out"),
        (["run", "x", "y", "--out", "z"], "unexpected extra argument"),
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


# The whole way


def test_pictures_from_simulation_to_evaluation(lumidock, tmp_path):
    save_camera(CAMERA, tmp_path / "camera.yaml")
    (tmp_path / "station.yaml").write_text(yaml.safe_dump(STATION))
    files = ("--camera", tmp_path / "camera.yaml", "--station", tmp_path / "station.yaml")
    simulated = lumidock("sim", "approach", *files, *SET, "--out", tmp_path / "sim")
    assert simulated == (0, f"7 frames written to {tmp_path / 'sim'}\n", "")

    code, out, err = lumidock("run", tmp_path / "sim", *PAPER, "--out", tmp_path / "run")
    assert (code, err) == (0, "")
    assert re.fullmatch(r"7 frames: [67] valid, 0 guide only, [01] no fix; written to .*\n(not valid: .*\n)?", out)
    code, out, err = lumidock("eval", tmp_path / "run", tmp_path / "sim")
    assert (code, err) == (0, "")
    assert "of 7 frames" in out
    code, out, err = lumidock("eval", tmp_path / "run", tmp_path / "sim", "--json")
    assert json.loads(out)["valid"] >= 6
    assert json.loads(out)["error"]["axial_m"]["median"] < 0.1

    folder = ("run", tmp_path / "sim" / "frames", *files, *PAPER, "--fps", "4", "--json")
    code, out, err = lumidock(*folder, "--out", tmp_path / "images")
    assert (code, err) == (0, "")
    assert json.loads(out)["valid"] >= 6
    same = [[{**row, "latency_us": ""} for row in fixes(tmp_path / name)] for name in ("run", "images")]
    assert same[0] == same[1]
    assert (tmp_path / "images" / "camera.yaml").read_bytes() == (tmp_path / "camera.yaml").read_bytes()


def test_a_video_is_run(lumidock, tmp_path):
    write_video(tmp_path / "dive.mp4")
    save_camera(cli.load_camera(cli.shipped_or_path("camera", "imx264-60deg")), tmp_path / "camera.yaml")
    text = (tmp_path / "camera.yaml").read_text().replace("2448", "32").replace("2048", "24")
    (tmp_path / "camera.yaml").write_text(text)
    words = ("--camera", tmp_path / "camera.yaml", "--station", "cage-2x2x5", "--out", tmp_path / "run")
    assert lumidock("run", tmp_path / "dive.mp4", *PAPER, *words)[0] == 0
    assert [row["t_ns"] for row in fixes(tmp_path / "run")] == [str(i * 50_000_000) for i in range(6)]


def test_shipped_detections_from_simulation_to_evaluation(lumidock, tmp_path):
    assert lumidock("sim", "trials", "--detections", "--out", tmp_path / "sim") == (
        *(0, f"76 frames written to {tmp_path / 'sim'}\n", ""),
    )
    assert lumidock("run", tmp_path / "sim", *PAPER, "--out", tmp_path / "run")[0] == 0
    code, out, _ = lumidock("eval", tmp_path / "run", tmp_path / "sim")
    assert code == 0
    assert {"front:", "rear:", "names:"} <= set(out.split())


@pytest.mark.parametrize("seed", [0, 7])
def test_the_same_seed_gives_the_same_sequence(lumidock, tmp_path, seed):
    for name in ("one", "two"):
        lumidock("sim", "trials", "--detections", "--seed", seed, "--out", tmp_path / name)
    lumidock("sim", "trials", "--detections", "--seed", seed + 1, "--out", tmp_path / "other")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert contents(tmp_path / "one") != contents(tmp_path / "other")


class Guesser:
    """A method that says of every frame what the test wants; remembers how it was made."""

    T = np.diag([1.0, -1.0, -1.0, 1.0])

    def __init__(self, station, camera, config, cold=False):
        made = (len(station), camera.width, config, cold)
        self.made.append(made)

    def process_detections(self, detections):
        valid, guided = int(detections.frame) in (0, 1, 4), int(detections.frame) in (1, 2, 3)
        self.T[2, 3] = 4.0 - 0.25 * int(detections.frame)
        return Fix(
            *(detections.frame, detections.t_ns, "tracking", "front", len(detections), 5),
            T_dock_cam=self.T.copy() if valid else None,
            reason="" if valid else "protection",
            covariance=0.01 * np.eye(6) if valid else None,
            protection=Protection(0.1, 0.1, 0.1) if valid else None,
            guide=Guide(0.0, 0.0, self.T[2, 3], 0.02, 0.2) if guided else None,
        )


@pytest.fixture
def guesser(monkeypatch):
    """Stands in for lumidock's own method; the list of how it was made."""
    monkeypatch.setattr(Guesser, "made", [], raising=False)
    monkeypatch.setitem(sys.modules, "lumidock.localizer", SimpleNamespace(Localizer=Guesser))
    return Guesser.made


@pytest.mark.parametrize(("words", "cold"), [([], False), (["--method", "lumidock", "--cold"], True)])
def test_the_method_is_lumidocks_own_unless_told_otherwise(lumidock, guesser, bare, tmp_path, words, cold):
    (tmp_path / "config.yaml").write_text("paper: {pso: {particles: 40}}\n")
    run = ("run", bare, *words, "--config", tmp_path / "config.yaml", "--out", tmp_path / "run")
    code, out, err = lumidock(*run)
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        f"7 frames: 3 valid, 2 guide only, 2 no fix; written to {tmp_path / 'run'}",
        "not valid: protection 4",
    ]
    ((lights, width, config, was_cold),) = guesser
    assert (lights, width, config.paper.pso.particles, was_cold) == (5, 320, 40, cold)
    described = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (described["method"], described["cold"], described["counts"]["guide"]) == ("lumidock", cold, 3)
    assert [row["guide"] for row in fixes(tmp_path / "run")] == ["0", "1", "1", "1", "0", "0", "0"]


def test_an_evaluation_tells_what_the_claims_are_worth(lumidock, guesser, bare, tmp_path):
    assert lumidock("run", bare, "--out", tmp_path / "run")[0] == len(guesser) - 1 == 0
    code, out, err = lumidock("eval", tmp_path / "run", bare)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[:3] == [
        "valid 3 of 7 frames (42.9 %), guide 3 of 7 frames (42.9 %); not valid: protection 4",
        "longest gap in valid 0.75 s; gaps over 0.45 s: 1",
        "longest gap in guide 0.25 s; gaps over 0.45 s: 0",
    ]
    assert any(line.split()[:4] == ["all", "7", "3", "3"] for line in lines)
    assert any(re.match(r"guide but over the alert limit \d of 7 frames", line) for line in lines)
    assert any(re.match(r"error over the protection level: lateral \d of 3, .*, range \d of 3", line) for line in lines)
    assert any(re.match(r"NEES [\d.]+ over 3 frames, honest is 6: front [\d.]+$", line) for line in lines)
    assert max(map(len, lines)) <= 120


def test_an_evaluation_of_the_papers_method_tells_of_no_claims(lumidock, bare, earlier):
    code, out, err = lumidock("eval", earlier, bare)
    assert (code, err) == (0, "")
    assert "NEES" not in out
    assert "protection level" not in out
    assert re.search(r"^valid but over the alert limit 0 of 7 frames$", out, re.MULTILINE)
    assert re.search(r"^named lights 0\.\d\d px rms", out, re.MULTILINE)


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
    "camera that is no camera": (write("camera.yaml", b"a: 1\n"), "camera.yaml: image_width"),
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


# The output folder


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


def test_a_folder_that_cannot_be_made_is_one_line(refusal, bare, tmp_path):
    tmp_path.chmod(0o555)
    folder = Path("/proc") if os.geteuid() == 0 else tmp_path  # root may write anywhere else
    assert str(folder / "run") in refusal("run", bare, *PAPER, "--out", folder / "run")


def test_the_source_is_not_written_into(refusal, sequence):
    before = contents(sequence)
    assert "is the source" in refusal("run", sequence, *PAPER, "--station", "cage-2x2x5", "--out", sequence, "--force")
    assert contents(sequence) == before


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


# Simulation


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["nowhere"], "no such scenario; there are any-roll, approach"),
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
    ],
    ids=lambda words: " ".join(words) if isinstance(words, list) else None,
)
def test_a_simulation_that_cannot_start_touches_nothing(refusal, sequence, words, match):
    before = contents(sequence)
    assert match in refusal("sim", *words, "--out", sequence, "--force")
    assert contents(sequence) == before


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


# Evaluation


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["none", "SEQUENCE"], "none: no such folder"),
        (["SEQUENCE", "SEQUENCE"], "sequence: neither a run nor a folder with runs"),
        (["RUN", "RUN"], "earlier/truth.csv: No such file"),
        (["RUN", "none"], "none: No such file"),
        (["RUN", "RUN/fixes.csv"], "earlier/fixes.csv: "),
    ],
    ids="-".join,
)
def test_an_evaluation_of_the_wrong_folders_is_one_line(refusal, sequence, earlier, words, match):
    if words[1].startswith("RUN/"):
        (earlier / "fixes.csv").write_text("frame\n")
    names = {"SEQUENCE": str(sequence), "RUN": str(earlier)}
    full = [names.get(word.split("/")[0], word) + word[len(word.split("/")[0]) :] for word in words]
    assert match in refusal("eval", *full)


def test_a_truth_that_lacks_frames_is_enough(lumidock, sequence, earlier):
    lines = (sequence / "truth.csv").read_text().splitlines(keepends=True)
    (sequence / "truth.csv").write_text("".join(lines[:4]))
    code, out, _ = lumidock("eval", earlier, sequence, "--json")
    assert code == 0
    assert json.loads(out)["frames"] == 7
    assert sum(row["frames"] for row in json.loads(out)["by_true_z"]) == 3


# Ends that come early


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Bare detections that take some ten seconds to run."""
    return simulate(tmp_path_factory.mktemp("long"), "path.frame_interval_s=0.001", bare=True)


def whole_rows(folder):
    """Number of rows of fixes.csv, all of them whole."""
    content = (folder / "fixes.csv").read_text()
    assert content.endswith("\n")
    assert len({line.count(",") for line in content.splitlines()}) == 1
    return content.count("\n") - 1


def stopped(folder, long, number):
    """A run stopped by a signal after some rows: its process."""
    process = start("run", long, *PAPER, "--out", folder)
    wait_for(lambda: (folder / "fixes.csv").exists() and (folder / "fixes.csv").read_text().count("\n") > 20)
    os.killpg(process.pid, number)
    return process, *process.communicate(timeout=30)


def test_a_killed_run_leaves_whole_rows(lumidock, long, tmp_path):
    process, _, _ = stopped(tmp_path / "run", long, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    count = whole_rows(tmp_path / "run")
    assert 20 <= count < 1501
    assert json.loads((tmp_path / "run" / "run.json").read_text())["counts"]["finished"] is False
    assert [row["frame"] for row in fixes(tmp_path / "run")] == [f"{i:06d}" for i in range(count)]
    code, out, _ = lumidock("eval", tmp_path / "run", long, "--json")
    assert (code, json.loads(out)["frames"]) == (0, count)


def test_an_interrupted_run_leaves_valid_files(lumidock, long, tmp_path):
    process, out, err = stopped(tmp_path / "run", long, signal.SIGINT)
    assert (process.returncode, out, err) == (130, "", "")
    counts = json.loads((tmp_path / "run" / "run.json").read_text())["counts"]
    assert 20 <= counts["frames"] == whole_rows(tmp_path / "run") < 1501
    assert counts["finished"] is False
    assert lumidock("eval", tmp_path / "run", long)[0] == 0


def test_an_interrupted_simulation_can_be_done_again(lumidock, tmp_path):
    process = start("sim", "approach", "--out", tmp_path / "sim")
    wait_for(lambda: len(list((tmp_path / "sim").glob("frames/*"))) > 2)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, "", "")
    assert lumidock("run", tmp_path / "sim", "--out", tmp_path / "run")[0] == 2
    assert lumidock("sim", "trials", "--detections", "--out", tmp_path / "sim", "--force")[0] == 0


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["eval", "RUN", "TRUTH"]], ids=" ".join)
def test_a_closed_pipe_is_no_traceback(earlier, bare, words):
    names = {"RUN": earlier, "TRUTH": bare}
    reading, writing = os.pipe()
    os.close(reading)
    process = start(*(names.get(word, word) for word in words), stdout=writing)
    os.close(writing)
    assert process.communicate(timeout=30)[1] == ""
    assert process.returncode == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_behind_the_output_is_one_line():
    with open("/dev/full", "w") as full:
        process = start("--help", stdout=full)
        assert process.communicate(timeout=30)[1] == "lumidock: file system: No space left on device\n"
    assert process.returncode == 2
