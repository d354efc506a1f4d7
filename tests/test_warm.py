"""Warming up compiles all that a docking needs, whatever its pixels."""

import subprocess
import sys

import pytest
from bench.shipped import shipped_camera, shipped_station
from test_run import simulate

from lumidock.app.warm import warm_up
from lumidock.localizer import Localizer
from lumidock.paper import PaperLocalizer

COUNT = """
import sys
from pathlib import Path
import numpy as np
from lumidock._kernels.compiling import ENTRIES
from lumidock.camera import load_camera
from lumidock.datatypes import Frame
from lumidock.localizer import Localizer
from lumidock.station import load_station
from lumidock.streams.sources import open_source
from lumidock.app.warm import warm_up

def compiled():
    return {(one.__module__, one.__name__, str(known)) for one in ENTRIES for known in one.signatures}

source = open_source(Path(sys.argv[1]))
dock, lens = load_station(source.station), load_camera(source.camera)
fixes = [fix for _, fix in warm_up(Localizer(dock, lens).process, dock, lens)]
before, localizer = compiled(), Localizer(dock, lens)
for number, frame in enumerate(source.items()):
    image = np.zeros_like(frame.image) if number == 4 else frame.image
    fixes.append(localizer.process(Frame(frame.name, frame.t_ns, image, encoding=frame.encoding)))
print([fix.status for fix in fixes])
print(sorted(compiled() - before))
"""


@pytest.mark.parametrize("pixels", ["bgr8", "mono8", "mono16", "bayer8", "bayer16"])
def test_nothing_is_compiled_after_warming_up(tmp_path, pixels):
    exposure = "0.05" if pixels == "bgr8" else "0.5"
    simulate(tmp_path, f"output={{pixels: {pixels}, file: png}}", f"sensor.exposure_ms={exposure}")
    done = subprocess.run([sys.executable, "-c", COUNT, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    statuses, compiled = done.stdout.splitlines()
    assert statuses.count("tracking") >= 3
    assert compiled == "[]"


@pytest.mark.parametrize("method", [Localizer, PaperLocalizer])
def test_the_drawn_dock_is_followed(method):
    found = dict(warm_up(method(shipped_station(), shipped_camera()).process, shipped_station(), shipped_camera()))
    assert set(found) == {"8 bits", "16 bits"}
    assert {fix.status for fix in found.values()} == {"tracking"}
