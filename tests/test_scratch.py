"""Temporary folders of commands: whose they are, and when they go."""

import multiprocessing
import os
import signal
import tempfile

import pytest

from lumidock.cli.scratch import scratch_folder


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def hold(told):
    with scratch_folder() as folder:
        (folder / "file").write_text("x")
        told.put(str(folder))
        signal.pause()


def test_a_folder_goes_with_its_command(place):
    with scratch_folder() as folder:
        (folder / "file").write_text("x")
        assert list(place.iterdir()) == [folder]
        assert folder.stat().st_mode & 0o077 == 0
    assert not list(place.iterdir())


def test_a_folder_of_a_killed_command_goes_with_the_next_and_no_earlier(place):
    context = multiprocessing.get_context("fork")
    told = context.Queue()
    process = context.Process(target=hold, args=(told,))
    process.start()
    held = told.get(timeout=30)
    with scratch_folder():
        assert os.path.exists(held)
    process.kill()
    process.join()
    assert os.path.exists(held)
    with scratch_folder() as folder:
        assert list(place.iterdir()) == [folder]


def test_what_is_no_folder_of_ours_stays(place):
    (place / "lumidock-held-file").write_text("x")
    (place / "elsewhere").mkdir()
    (place / "elsewhere" / "kept").write_text("x")
    (place / "lumidock-held-link").symlink_to(place / "elsewhere")
    with scratch_folder():
        pass
    assert sorted(path.name for path in place.rglob("*")) == [
        "elsewhere",
        "kept",
        "lumidock-held-file",
        "lumidock-held-link",
    ]
