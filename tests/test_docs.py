"""README and docs/: no dead link, tables made by commands that exist, every command runs."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest
import tomllib
from bench.__main__ import BENCHES, between_marks
from bench.commands import main as commands_of_the_code
from bench.configuration import main as configuration
from bench.shipped import CAMERA_FILE, STATION_FILE
from commandline import LUMIDOCK

from lumidock.reproduce.experiments import chosen

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md")), ROOT / "CONTRIBUTING.md", ROOT / "CONVENTIONS.md"]
MAX_README_LINES = 160
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHORT = "--set path.start_z_m=9.5 --set path.end_z_m=8.3 --set path.frame_interval_s=0.2"
LONG = re.compile(r"lumidock (demo|reproduce|warm)\b")  # minutes: run by the tests that are marked slow


def blocks(page, language):
    return [text for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")) if kind == language]


def commands(page):
    return [line for block in blocks(page, "bash") for line in block.replace("\\\n", " ").splitlines() if line.strip()]


def prose(page):
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def anchor_of(title):
    """The anchor of a heading, as GitHub and mkdocs make it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")


def anchors(page):
    return {anchor_of(title) for title in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_link_is_dead(page):
    dead = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = unquote(link).partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            dead.append(link)
    assert dead == []


def test_the_readme_is_short():
    assert len(README.read_text().splitlines()) <= MAX_README_LINES


def test_configuration_page_is_what_the_code_says():
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    _, lines = configuration()
    assert between_marks("configuration").search(page)[0].splitlines()[2:-2] == lines, (
        "make it anew: python -m bench configuration --docs"
    )


def test_commands_page_is_what_the_code_says():
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    _, lines = commands_of_the_code()
    assert between_marks("commands").search(page)[0].splitlines()[2:-2] == lines, (
        "make it anew: python -m bench commands --docs"
    )


def test_every_option_that_a_page_names_exists():
    known = set(re.findall(r"--[a-z][a-z0-9-]+", (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")))
    for page in PAGES:
        for line in re.findall(
            r"^ *(lumidock .*)$", page.read_text(encoding="utf-8").replace("\\\n", " "), re.MULTILINE
        ):
            assert set(re.findall(r"(?<= )--[a-z][a-z0-9-]+", line)) <= known | {"--help", "--version"}, (
                page.name,
                line,
            )


def test_the_site_has_every_page():
    listed = set(re.findall(r"[\w-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert listed == {page.name for page in (ROOT / "docs").glob("*.md")}


def test_every_table_has_a_bench_and_is_filled():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"<!-- ([a-z0-9-]+) -->", text):
            assert name in BENCHES
            assert f"python -m bench {name} --docs" in " ".join(text.split())
            assert "|" in between_marks(name).search(text)[0]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_bench_that_is_named_exists(page):
    named = re.findall(r"python\s+-m\s+bench\s+([a-z0-9-]+)", page.read_text(encoding="utf-8"))
    assert set(named) <= BENCHES.keys()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_make_target_that_is_named_exists(page):
    for target in set(re.findall(r"`make ([a-z]+)`", page.read_text(encoding="utf-8"))):
        done = subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_every_extra_that_is_named_exists():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for page in PAGES:
        for words in re.findall(r"`\[([a-z,]+)\]`|'[^']*\[([a-z,]+)\]'", page.read_text(encoding="utf-8")):
            assert set("".join(words).split(",")) <= extras.keys()


def test_every_section_of_the_reproduction_is_listed():
    rows = re.findall(r"^\| (`.*`) \|", (ROOT / "docs" / "research.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(re.findall(r"`([^`]+)`", " ".join(rows))) == sorted(one.name for one in chosen(()))


@pytest.fixture(scope="module")
def approach(tmp_path_factory):
    """A short rendered approach, its run and a bag of it: what stands for a user's own recording."""
    folder = tmp_path_factory.mktemp("recording")
    run_in(folder, f"lumidock sim approach --seed 3 {SHORT} --out approach")
    run_in(folder, "lumidock run approach --out approach-run")
    run_in(folder, "lumidock export approach-run dive.mcap --source approach")
    return folder


@pytest.fixture
def desk(approach, tmp_path):
    """A folder with what a user has before reading: a recording, a station and a camera file."""
    shutil.copy(approach / "dive.mcap", tmp_path)
    shutil.copy(STATION_FILE, tmp_path / "dock.yaml")
    shutil.copy(CAMERA_FILE, tmp_path / "camera.yaml")
    shutil.copy(next((approach / "approach" / "frames").iterdir()), tmp_path / "0.png")
    return tmp_path


def run_in(folder, line):
    words = shlex.split(line)
    assert words[0] == "lumidock", f"{line}: what is this?"
    done = subprocess.run([LUMIDOCK, *words[1:]], cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"{line}\n{done.stderr or done.stdout}"
    return done.stdout


def write_files(page, folder):
    """The files that a page shows, each by the name in its first line."""
    for text in blocks(page, "yaml"):
        if found := re.match(r"# ([\w-]+\.yaml)\n", text):
            (folder / found[1]).write_text(text)


def run_page(page, folder):
    """Every command of a page, in order, but for those that install or take minutes."""
    write_files(page, folder)
    for line in commands(page):
        if not line.startswith("pip ") and not LONG.match(line):
            run_in(folder, line)


def test_every_command_of_the_readme_runs(desk):
    run_page(README, desk)
    text = run_in(desk, "lumidock eval approach-run approach")
    assert re.search(r"over the alert limits?:? 0 of", text)


def test_every_command_of_the_guide_runs(desk, approach):
    shutil.copytree(approach / "approach", desk / "approach")
    run_page(ROOT / "docs" / "guide.md", desk)


OTHERS = {
    *("configuration.md", "simulator.md", "simulator-physics.md", "closed-loop.md"),
    *("start.md", "bluerov2.md", "ros-bags.md", "research.md"),
}


@pytest.mark.parametrize("name", sorted(OTHERS))
def test_every_command_of_the_other_pages_runs(desk, name):
    run_page(ROOT / "docs" / name, desk)


def test_no_other_page_has_commands():
    run = {"README.md", "guide.md", *OTHERS}
    assert {page.name for page in PAGES if commands(page)} <= run


def test_python_of_the_readme_runs(desk):
    (code,) = blocks(README, "python")
    done = subprocess.run([sys.executable, "-c", code], cwd=desk, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "Protection" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_long_command_runs(page, tmp_path):
    for line in commands(page):
        if LONG.match(line):
            run_in(tmp_path, line)


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHES)
def test_every_bench_runs(name):
    done = subprocess.run([sys.executable, "-m", "bench", name], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
