"""Requests to a console in this process, and what the tests of its parts share."""

import time

import numpy as np
import pytest

from lumidock.app.console.guard import Guard
from lumidock.app.console.wizards import Files
from lumidock.datatypes import Detections, Match

pytest.importorskip("starlette")
from starlette.testclient import TestClient

from lumidock.app.console.routes import application

TOKEN = "a-token-for-tests"
HEAD_ON = np.diag([1.0, -1, -1, 1])
BEARER = {"Authorization": f"Bearer {TOKEN}"}
HOST = "http://127.0.0.1:8780"
OWN = {"Host": "127.0.0.1:8780"}


def at(z_m=4.0):
    T = HEAD_ON.copy()
    T[2, 3] = z_m
    return T


def detected(uv, light, p_light=1.0):
    d = Detections.from_uv("a", 5, np.array(uv, float).reshape(-1, 2))
    d.p_light[:] = p_light
    return Match(d, np.array(light, np.int64))


def files(folder, tmp_path):
    return Files(folder / "station.yaml", folder / "camera.yaml", tmp_path)


def client(console, host="127.0.0.1", url=HOST):
    return TestClient(Guard(application(console), host, TOKEN), base_url=url)


def result(page, answer):
    """The result of a job that a request started."""
    assert answer.status_code == 200, answer.text
    job = ended(page, answer)
    assert job["state"] == "done", job
    return job["result"]


def ended(page, answer):
    """The state of such a job once it has ended."""
    end = time.monotonic() + 240
    while (job := page.get(f"/api/jobs/{answer.json()['number']}").json())["state"] in ("waiting", "running"):
        assert time.monotonic() < end, job
        time.sleep(0.2)
    return job
