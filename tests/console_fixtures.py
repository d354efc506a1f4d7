"""Consoles of a small dock: of a live camera, and of a recording."""

import pytest
from commandline import wait_for
from test_run import CAMERA, simulate

from lumidock.app.console.frame_view import Scene
from lumidock.app.console.live import LiveView
from lumidock.app.console.replay import Recording, Replay
from lumidock.config import Config
from lumidock.methods import localizer_of
from lumidock.station import load_station
from lumidock.streams.sources import open_source

# of the console's jobs; or the tests would wait for whatever else the machine does
_SAME_PRIORITY = "lumidock.app.console.jobs._NICE", 0


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("sequence"))


@pytest.fixture(scope="session")
def scene(folder):
    return Scene(load_station(folder / "station.yaml"), CAMERA)


@pytest.fixture
def live(folder, scene, tmp_path, monkeypatch):
    """A console of a live camera whose newest frame is the first of the sequence."""
    from asking import files

    from lumidock.app.console.routes import Console

    monkeypatch.setattr(*_SAME_PRIORITY)
    view = LiveView(scene, lambda: {"camera": {"frames": 1}})
    console = Console(files(folder, tmp_path), "lumidock", Config(), "dock small", live=view, health=view.health)
    yield console
    console.close()


@pytest.fixture
def replay(folder, scene, tmp_path, monkeypatch):
    """A console of the sequence, read to its end."""
    from asking import files

    from lumidock.app.console.routes import Console

    monkeypatch.setattr(*_SAME_PRIORITY)
    localizer = localizer_of("lumidock", scene.station, CAMERA, Config())
    recording = Recording(
        scene, folder / "station.yaml", folder / "camera.yaml", "lumidock", Config(), open_source(folder), None
    )
    console = Console(files(folder, tmp_path), "lumidock", Config(), "dock small")
    console.replay = Replay(recording, console.jobs, tmp_path, localizer)
    console.replay.start()
    wait_for(lambda: console.replay.ended)
    assert console.replay.problem == ""
    yield console
    console.close()
