"""The same frames give the same fixes, whatever they come in."""

import csv
import json
from fractions import Fraction

import av
import bags
import numpy as np
import pytest
from test_run import CAMERA, simulate

from lumidock.streams.sources import open_source


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Seven rendered frames, their stamps whole milliseconds."""
    return simulate(tmp_path_factory.mktemp("sequence"))


def frames(sequence):
    return list(open_source(sequence).items())


def as_bag(folder, kind, sequence):
    pictures = [
        ("/cam/image_raw", f.t_ns, bags.raw(f.t_ns, f.image, "bgr8" if f.image.ndim == 3 else "mono8"))
        for f in frames(sequence)
    ]
    return bags.write(folder / kind, kind, [("/cam/camera_info", 1, bags.info(1, CAMERA)), *pictures])


def as_video(folder, sequence):
    """FFV1, which loses nothing, with stamps in milliseconds."""
    path = folder / "lossless.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=4)
        stream.width, stream.height, stream.pix_fmt = CAMERA.width, CAMERA.height, "bgr0"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for f in frames(sequence):
            color = f.image if f.image.ndim == 3 else np.dstack([f.image] * 3)
            picture = av.VideoFrame.from_ndarray(color, "bgr24").reformat(format="bgr0")
            picture.pts, picture.time_base = f.t_ns // 10**6, stream.time_base
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path


def fixes(run):
    with (run / "fixes.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "latency_us"} for row in csv.DictReader(file)]


@pytest.mark.parametrize("method", ["lumidock", "paper"])
def test_a_folder_a_video_and_bags_give_the_same_fixes(lumidock, sequence, tmp_path, method):
    sources = [as_video(tmp_path, sequence), *(as_bag(tmp_path, kind, sequence) for kind in bags.KINDS)]
    station, camera = ("--station", sequence / "station.yaml"), ("--camera", sequence / "camera.yaml")
    assert lumidock("run", sequence, "--method", method, "--out", tmp_path / "wanted")[0] == 0
    wanted = fixes(tmp_path / "wanted")
    assert sum(row["valid"] == "1" or row["guide"] == "1" for row in wanted) >= 3
    for number, source in enumerate(sources):
        more = camera if source.suffix == ".mkv" else ()  # a bag brings its own
        out = tmp_path / f"run{number}"
        code, _, err = lumidock("run", source, *station, *more, "--method", method, "--out", out)
        assert (code, err) == (0, "")
        assert fixes(out) == wanted


def test_inspect_says_what_a_bag_holds(lumidock, sequence, tmp_path):
    path = as_bag(tmp_path, "mcap", sequence)
    code, out, err = lumidock("inspect", path, "--json")
    result = json.loads(out)
    assert (code, err, result["frames"], result["calibration"]["frames_of_another_size"]) == (0, "", 7, 0)
    assert {topic["name"]: topic["messages"] for topic in result["topics"]} == {
        "/cam/camera_info": 1,
        "/cam/image_raw": 7,
    }
    code, out, err = lumidock("inspect", path, "--camera", "imx264-60deg")
    assert (code, err) == (0, "")
    assert "does NOT fit 7 frames" in out
    assert "320 x 256 color, 7 frames" in out
