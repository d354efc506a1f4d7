"""The command line: its help, and the whole way from a simulation to an evaluation."""

import json
import re

import numpy as np
import pytest
import yaml
from commandline import PAPER, contents, fixes, quiet
from test_run import CAMERA, SETTINGS, STATION
from test_sources import write_video

from lumidock import cli, methods
from lumidock.camera import save_camera
from lumidock.cli import progress as progress_lines
from lumidock.datatypes import Fix, Guide, Protection
from lumidock.sim.scenario import shipped_scenarios

COMMANDS = ("run", "sim", "eval", "demo", "warm")
SET = [word for setting in SETTINGS for word in ("--set", setting)]


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


def test_progress_without_a_terminal_is_plain_lines(monkeypatch, capsys):
    monkeypatch.setattr(progress_lines, "PLAIN_EVERY_S", 0.0)
    with progress_lines.progress_bar("simulating") as progress:
        for done in (1, 2, 4):
            progress(done, 4)
        progress(5, None)
    lines = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"simulating: 1 of 4, elapsed 0:00:0\d", lines[0])
    assert re.fullmatch(r"simulating: 2 of 4, elapsed 0:00:0\d, remaining about 0:00:0\d", lines[1])
    assert re.fullmatch(r"simulating: 5, elapsed 0:00:0\d", lines[3])
    monkeypatch.setattr(progress_lines, "PLAIN_EVERY_S", 10.0)
    with progress_lines.progress_bar("quick") as progress:
        progress(1, 2)
    assert capsys.readouterr().err == ""


def test_the_time_that_remains_forgets_a_stop(monkeypatch, capsys):
    seconds = iter([0.0, *(float(k) for k in range(1, 11)), *(60.0 + k for k in range(11, 51))])  # a minute, compiling
    monkeypatch.setattr(progress_lines, "PLAIN_EVERY_S", 0.0)
    monkeypatch.setattr(progress_lines.time, "monotonic", lambda: next(seconds))
    with progress_lines.progress_bar("localizing") as progress:
        for done in range(1, 51):
            progress(done, 100)
    lines = capsys.readouterr().err.splitlines()
    assert lines[9].endswith("10 of 100, elapsed 0:00:10, remaining about 0:01:30")
    assert lines[49].endswith("50 of 100, elapsed 0:01:50, remaining about 0:00:50")


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00:00"), (61, "0:01:01"), (3600 * 30 + 59.6, "30:01:00")])
def test_durations(seconds, text):
    assert progress_lines.duration(seconds) == text


def test_every_command_that_ends_in_figures_speaks_json(lumidock):
    for command in ("run", "sim", "eval", "campaign", "demo", "export", "report", "reproduce", "serve", "doctor"):
        assert "--json" in lumidock(command, "--help")[1], command
    for command in (("station", "check"), ("calib", "check")):
        assert "--json" in lumidock(*command, "--help")[1], command


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
    assert (code, quiet(err)) == (0, True)
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
    code, _, err = lumidock("run", tmp_path / "dive.mp4", *PAPER, *words)  # K is still that of the large pictures
    assert (code, "outside the middle half of 32x24 pixels" in err) == (2, True)
    assert lumidock("run", tmp_path / "dive.mp4", *PAPER, *words, "--trust-calibration")[0] == 0
    assert [row["t_ns"] for row in fixes(tmp_path / "run")] == [str(i * 50_000_000) for i in range(6)]


def test_shipped_detections_from_simulation_to_evaluation(lumidock, tmp_path):
    assert lumidock("sim", "trials", "--detections", "--out", tmp_path / "sim") == (
        *(0, f"76 frames written to {tmp_path / 'sim'}\n", ""),
    )
    assert lumidock("run", tmp_path / "sim", *PAPER, "--out", tmp_path / "run")[0] == 0
    code, out, _ = lumidock("eval", tmp_path / "run", tmp_path / "sim")
    assert code == 0
    assert {"front:", "rear:", "identities:"} <= set(out.split())


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
    monkeypatch.setattr(methods, "Localizer", Guesser)
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
    assert any(re.match(r"NEES [\d.]+ over 3 frames \(front [\d.]+\)$", line) for line in lines)
    assert max(map(len, lines)) <= 120


def test_an_evaluation_says_what_run_json_knows(lumidock, guesser, bare, tmp_path):
    assert lumidock("run", bare, "--out", tmp_path / "run")[0] == len(guesser) - 1 == 0
    path = tmp_path / "run" / "run.json"
    described = json.loads(path.read_text())
    described["counts"] |= {"finished": False, "over_limit": {"lateral": {"frames": 4, "least": 1.02, "most": 3.4}}}
    path.write_text(json.dumps(described))
    for words in ([], [bare]):
        code, out, err = lumidock("eval", tmp_path / "run", *words)
        assert (code, err) == (0, "")
        assert "\nprotection: lateral level over its alert limit in 4 frames, 1.02 to 3.4 times\n" in out
        assert "\nnot finished: the run was interrupted or goes on, and only its 7 frames so far count\n" in out
    found = json.loads(lumidock("eval", tmp_path / "run", bare, "--json")[1])
    assert (found["finished"], found["over_limit"]["lateral"]["frames"]) == (False, 4)


def test_an_evaluation_of_the_papers_method_tells_of_no_claims(lumidock, bare, earlier):
    code, out, err = lumidock("eval", earlier, bare)
    assert (code, err) == (0, "")
    assert "NEES" not in out
    assert "protection level" not in out
    assert re.search(r"^valid but over the alert limit 0 of 7 frames$", out, re.MULTILINE)
    assert re.search(r"^identified lights 0\.\d\d px rms", out, re.MULTILINE)


def test_a_truth_that_lacks_frames_is_enough(lumidock, sequence, earlier):
    lines = (sequence / "truth.csv").read_text().splitlines(keepends=True)
    (sequence / "truth.csv").write_text("".join(lines[:4]))
    code, out, _ = lumidock("eval", earlier, sequence, "--json")
    assert code == 0
    assert json.loads(out)["frames"] == 7
    assert sum(row["frames"] for row in json.loads(out)["by_true_z"]) == 3
