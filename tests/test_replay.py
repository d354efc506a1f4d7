"""The same frames give the same fixes, whatever they come in."""

import csv
import json
from fractions import Fraction
from pathlib import Path

import av
import bags
import numpy as np
import pytest
from commandline import quiet
from test_run import CAMERA, simulate

from lumidock.datatypes import Fix, Frame
from lumidock.picture import encoding_of
from lumidock.station import load_station
from lumidock.streams.sinks import Setting, open_file_sink
from lumidock.streams.sources import open_source


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Seven rendered frames, their stamps whole milliseconds."""
    return simulate(tmp_path_factory.mktemp("sequence"))


def frames(sequence):
    return list(open_source(sequence).items())


def as_bag(folder, kind, sequence):
    pictures = [("/cam/image_raw", f.t_ns, bags.raw(f.t_ns, f.image, encoding_of(f))) for f in frames(sequence)]
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
    assert sum(row["valid"] == "1" or row["guide"] == "1" for row in wanted) >= 2  # of 7; the first are not proven
    for number, source in enumerate(sources):
        more = camera if source.suffix == ".mkv" else ()  # a bag brings its own
        out = tmp_path / f"run{number}"
        code, _, err = lumidock("run", source, *station, *more, "--method", method, "--out", out)
        assert (code, quiet(err)) == (0, True)
        assert fixes(out) == wanted


@pytest.mark.parametrize("pixels", ["bayer8", "bayer16", "mono16"])
def test_raw_pictures_give_the_same_fixes_from_a_folder_and_from_bags(lumidock, tmp_path, pixels):
    settings = ("sensor.exposure_ms=0.5", f"output={{pixels: {pixels}, pattern: grbg, file: png}}")
    raw = simulate(tmp_path / "raw", *settings)
    encoding = f"bayer_grbg{pixels[5:]}" if pixels.startswith("bayer") else "mono16"
    assert {encoding_of(frame) for frame in frames(raw)} == {encoding}
    station = ("--station", raw / "station.yaml")
    assert lumidock("run", raw, "--out", tmp_path / "wanted")[0] == 0
    wanted = fixes(tmp_path / "wanted")
    assert sum(row["valid"] == "1" or row["guide"] == "1" for row in wanted) >= 2  # of 7; the first are not proven
    for kind in bags.KINDS:
        bag, out = as_bag(tmp_path, kind, raw), tmp_path / f"run-{kind}"
        assert [item.encoding for item in open_source(bag).items()] == [item.encoding for item in frames(raw)]
        code, _, err = lumidock("run", bag, *station, "--out", out)
        assert (code, quiet(err)) == (0, True)
        assert fixes(out) == wanted
        code, text, _ = lumidock("inspect", bag)
        assert (code, f"size        320 x 256 {encoding}, 7 frames" in text) == (0, True)
    code, _, err = lumidock("run", bag, *station, "--method", "paper", "--out", tmp_path / "paper")
    assert (code, quiet(err)) == (0, True)


@pytest.mark.parametrize("kind", [".mp4", ".mcap"])
def test_what_is_shown_of_a_mosaic_has_its_colors(tmp_path, kind):
    """A blue field, by the letters of the mosaic, is blue in every picture that is made for a person."""
    mosaic = np.zeros((256, 320), np.uint16)
    mosaic[1::2, 0::2] = 60000  # of bayer_grbg
    frame, path = Frame("a", 1, mosaic, encoding="bayer_grbg16"), tmp_path / f"shown{kind}"
    sink = open_file_sink(path, Setting(load_station(Path("src/lumidock/stations/cage-2x2x5.yaml")), CAMERA))
    sink.add(frame, Fix("a", 1, "none", "search", reason="no_lights"), 1)
    sink.close()
    (shown,) = open_source(path).items()
    blue, green, red = np.median(shown.image[100:], axis=(0, 1))  # below the caption
    assert blue > 180
    assert max(green, red) < 60


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
    assert "320 x 256 bgr8, 7 frames" in out
