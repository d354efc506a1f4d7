"""The command line in processes of its own, and what is in the folders that it writes."""

import csv
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

NO_DISTORTION = (
    "lumidock: warning: no distortion at all"  # of the simulator's cameras, without a word of where they are from
)
LUMIDOCK = str(Path(sys.executable).with_name("lumidock"))
PLAIN = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
PAPER = ("--method", "paper")
VEHICLE = "schema: 1\nT_body_cam: {translation: [0.8, 0, 0.1], quat_xyzw: [-0.5, 0.5, -0.5, 0.5]}\n"
AHEAD = np.array([[0.0, 0, 1, 0.8], [-1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1]])  # T_body_cam of that file


def start(*words, **options):
    """A command in a process group of its own."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen([LUMIDOCK, *words], **(pipes | {"env": PLAIN} | options))


def serve(*words):
    """A server that has begun to serve, and the `url` of its console or health page, without the token."""
    command = [LUMIDOCK, "serve", *map(str, words), "--health-port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.url = process.stdout.readline().split()[-1].partition("#")[0]
    return process


def wait_for(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fixes(folder):
    with (folder / "fixes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def quiet(err):
    """Whether nothing stands on standard error but that a simulated camera has no distortion."""
    return all(line.startswith(NO_DISTORTION) for line in err.splitlines())
