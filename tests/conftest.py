"""What the tests share: seeded draws, strategies for SE(3), numeric derivatives, closeness, refusals, a small run."""

import json
import math
import shutil
import socket
import sys
import zlib
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import zenoh
from commandline import PAPER
from hypothesis import settings
from hypothesis import strategies as st
from numba import njit
from numpy.testing import assert_allclose
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation
from test_run import simulate

from lumidock import cli
from lumidock.cli import progress
from lumidock.errors import InputError

pytest_plugins = ["console_fixtures"]

settings.register_profile("lumidock", derandomize=True, deadline=None, database=None, max_examples=200)
settings.load_profile("lumidock")

assert_close = partial(assert_allclose, rtol=0.0, atol=1e-12)  # absolute: relative slack hides what is small


@pytest.fixture
def rng(request):
    """Random generator seeded by the test's name; a failing test's report names the seed."""
    seed = zlib.crc32(request.node.nodeid.encode())
    request.node.add_report_section("setup", "rng", f"numpy.random.default_rng({seed})")
    return np.random.default_rng(seed)


@st.composite
def rotation_vectors(draw):
    """Rotation vectors (3,) rad up to pi long: uniform, tangent-normal, near identity and near pi."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    tiny = 10.0 ** -rng.exponential(4)
    return {
        "uniform": Rotation.random(rng=rng).as_rotvec(),
        "normal": axis * min(abs(rng.normal()), np.pi),
        "near identity": axis * tiny,
        "near pi": axis * (np.pi - tiny),
        "none": np.zeros(3),
    }[draw(st.sampled_from(["uniform", "normal", "near identity", "near pi", "none"]))]


def vectors(limit):
    """Vectors (3,) within a cube of half width `limit`."""
    return st.tuples(*[st.floats(-limit, limit)] * 3).map(np.array)


def tangents(limit_m=30.0):
    """Tangent vectors (6,) of SE(3), [m, rad]."""
    return st.builds(lambda t, w: np.concatenate([t, w]), vectors(limit_m), rotation_vectors())


def transform(t, w):
    """Transform (4, 4) of a translation and a rotation vector, by scipy alone."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(w).as_matrix()
    T[:3, 3] = t
    return T


def transforms(limit_m=30.0):
    """Transforms (4, 4)."""
    return st.builds(transform, vectors(limit_m), rotation_vectors())


def called(kernel):
    """A kernel that only other kernels can call, as Python can."""

    @njit
    def call(*args):
        return kernel(*args)

    return call


def numeric_jacobian(function, x, step=1e-6):
    """Central differences of `function` at `x` (n,): the value's shape with an axis of n behind it."""
    moves = step * np.eye(len(x))
    return np.stack([(function(x + move) - function(x - move)) / (2 * step) for move in moves], axis=-1)


@contextmanager
def refused(path, match):
    """An InputError of one line that names `path` and says `match`."""
    with pytest.raises(InputError, match=match) as caught:
        yield
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert str(path) in text


@pytest.fixture
def lumidock(monkeypatch, capfd):
    """Run the command line in this process; returns (exit code, standard output, standard error)."""

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["lumidock", *map(str, words)])
        monkeypatch.setattr(progress, "PLAIN_EVERY_S", math.inf)  # a slow machine prints progress
        with pytest.raises(SystemExit) as exited:
            cli.main()
        out, err = capfd.readouterr()
        lines = err.splitlines(keepends=True)  # without what depends on whether this checkout is compiled
        return exited.value.code, out, "".join(line for line in lines if "the numerical kernels" not in line)

    return call


@pytest.fixture
def refusal(lumidock):
    """Run the command line where it must refuse; returns its one line."""

    def call(*words):
        code, out, err = lumidock(*words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith("lumidock: ")
        return err

    return call


@pytest.fixture(scope="session")
def bare(tmp_path_factory):
    """A sequence of bare detections, which no test may change."""
    return simulate(tmp_path_factory.mktemp("bare"), bare=True)


@pytest.fixture
def sequence(bare, tmp_path):
    """A sequence of bare detections that a test may spoil."""
    return shutil.copytree(bare, tmp_path / "sequence")


@pytest.fixture
def earlier(lumidock, bare, tmp_path):
    """An earlier run over it."""
    assert lumidock("run", bare, *PAPER, "--out", tmp_path / "earlier")[0] == 0
    return tmp_path / "earlier"


@pytest.fixture
def router():
    """A zenoh session that listens on this machine, as a router would, and its endpoint."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    config = zenoh.Config()
    listening = {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    for key, value in listening.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield SimpleNamespace(session=session, endpoint=endpoint)


@pytest.fixture
def listener():
    """A UDP port and a function that reads all MAVLink messages that came to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        port.setblocking(False)
        link, sender = common.MAVLink(None), []

        def read():
            found = []
            while True:
                try:
                    content, address = port.recvfrom(4096)
                except BlockingIOError:
                    return found
                sender[:] = [address]
                found += link.parse_buffer(content) or []

        def peer():
            """Address of who sent last."""
            read()
            return sender[0]

        yield SimpleNamespace(port=port.getsockname()[1], read=read, peer=peer)
