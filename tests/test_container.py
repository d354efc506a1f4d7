"""The image: what it says of itself, and its steps carried out by an engine or in a root file system of its own."""

import json
import re
import shlex
import shutil
import subprocess
import time

import pytest
import tomllib
from dockerfile import ROOT, carried_out, instructions, stop, why_no_root

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NO_FILES = re.compile(r"dock\.yaml")  # what the image says when nobody has given it a dock
NAME = "lumidock-of-a-test"
SHORT = ("--set", "path.start_z_m=9.5", "--set", "path.end_z_m=9")


def arguments():
    """ARG names with their values."""
    return {
        name: value.strip('"')
        for word, rest in instructions()
        if word == "ARG"
        for name, _, value in [rest.partition("=")]
    }


def labels():
    """LABEL names with their texts, arguments filled in."""
    found = {}
    for word, rest in instructions():
        if word == "LABEL":
            name, _, value = shlex.split(rest)[0].partition("=")
            for argument, given in arguments().items():
                value = value.replace(f"${{{argument}}}", given)
            found[name] = value
    return found


def said(wanted):
    return [rest for word, rest in instructions() if word == wanted]


def test_the_labels_are_those_that_blueos_reads():
    found = labels()
    assert found["version"] == PROJECT["version"]
    assert set(found) >= {"permissions", "authors", "company", "readme", "links", "type", "tags", "requirements"}
    permissions = json.loads(found["permissions"])
    assert permissions["HostConfig"]["NetworkMode"] == "host"
    assert permissions["HostConfig"]["Binds"][0].endswith(f":{said('VOLUME')[0]}")
    assert list(permissions["ExposedPorts"]) == said("EXPOSE")
    assert json.loads(found["authors"])[0]["name"] == json.loads(found["company"])["name"]
    assert isinstance(json.loads(found["tags"]), list)
    assert isinstance(json.loads(found["links"]), dict)


def test_it_runs_as_nobody_in_particular_and_compiles_as_who_it_runs():
    words = [word for word, _ in instructions()]
    assert said("USER") == ["lumidock"]
    assert ("RUN", "lumidock warm") in instructions()[words.index("USER") :]
    assert "NUMBA_CPU_NAME=generic" in " ".join(said("ENV"))


def test_what_it_copies_is_there_and_let_through():
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    for rest in said("COPY"):
        if not rest.startswith("--from="):
            for name in rest.split()[:-1]:
                assert (ROOT / name).exists()
                assert name in kept


def test_its_extras_are_those_of_a_vehicle():
    (extras,) = re.findall(r"/source\[([a-z,]+)\]", " ".join(said("RUN")))
    assert set(extras.split(",")) <= PROJECT["optional-dependencies"].keys()
    assert {"console", "mavlink", "video"} <= set(extras.split(","))


def test_its_port_is_that_of_the_command():
    from lumidock.cli.console import _PORT

    assert said("EXPOSE") == [f"{_PORT}/tcp"]
    assert f":{_PORT}/health.json" in said("HEALTHCHECK")[0]


def engine():
    """docker or podman, where its service answers."""
    for name in ("docker", "podman"):
        if shutil.which(name) and subprocess.run([name, "info"], capture_output=True, timeout=60).returncode == 0:
            return name
    return None


@pytest.mark.slow
def test_an_engine_builds_it_and_it_is_healthy():
    found = engine()
    if found is None:
        pytest.skip("neither docker nor podman has an engine that answers")
    subprocess.run([found, "build", "--tag", NAME, str(ROOT)], check=True, timeout=3600)
    inside = f"lumidock sim approach {' '.join(SHORT)} --out /tmp/a && exec lumidock serve /tmp/a --loop"
    started = [found, "run", "--detach", "--rm", "--name", NAME, "--entrypoint", "sh", NAME, "-c", inside]
    subprocess.run(started, check=True, timeout=60)
    try:
        end = time.monotonic() + 300
        while "healthy" not in (state := inspected(found)) or "unhealthy" in state:
            assert time.monotonic() < end, state
            time.sleep(2)
    finally:
        subprocess.run([found, "stop", NAME], check=True, timeout=60)


def inspected(found):
    words = [found, "inspect", "--format", "{{.State.Health.Status}}", NAME]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
@pytest.mark.skipif(bool(why_no_root()), reason=why_no_root() or "a root file system can be made")
def test_its_steps_run_in_a_root_file_system_of_its_own(tmp_path):
    image = carried_out(tmp_path)
    assert image.run(["id", "-u"]).strip() == "10001"
    assert "no run waits" in image.run(["lumidock", "doctor"])
    refused = subprocess.run(
        image.command([*image.said["ENTRYPOINT"], *image.said["CMD"]]), capture_output=True, text=True
    )
    assert (refused.returncode, NO_FILES.search(refused.stderr) is not None) == (2, True), refused.stderr
    image.run(["lumidock", "sim", "approach", *SHORT, "--out", "a"])
    before = compiled(tmp_path)
    assert len(before) > 20
    words = ["serve", "a", "--loop", "--host", "0.0.0.0", "--console"]
    server = subprocess.Popen(image.command([*image.said["ENTRYPOINT"], *words]), stdout=subprocess.PIPE, text=True)
    try:
        assert re.match(r"console at http://0\.0\.0\.0:8780/#token=", server.stdout.readline())
        image.run(image.said["HEALTHCHECK"])
    finally:
        stop(server)
    assert server.returncode == 0
    image.run(["lumidock", "run", "a", "--out", "b"])
    assert compiled(tmp_path) == before


def compiled(folder):
    return {path.name for path in folder.rglob("var/cache/lumidock/**/*.nbc")}
