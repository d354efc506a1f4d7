import cv2
import numpy as np
import pytest
from conftest import refused
from numpy.testing import assert_array_equal

from lumidock.datatypes import Frame
from lumidock.errors import InputError
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source

PICTURES = np.random.default_rng(3).integers(0, 256, (3, 6, 8), np.uint8)
START = 1403636579763555584


def write(folder, names, pictures=PICTURES):
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in zip(names, pictures, strict=False):
        cv2.imwrite(str(folder / name), picture)


def test_hidden_files_are_no_pictures(tmp_path):
    write(tmp_path, ["1.png", "2.png", "._1.png"])
    (tmp_path / "._2.png").write_bytes(b"\0\5\x16\7")
    assert [item.name for item in open_source(tmp_path, Reading(10.0)).items()] == ["1", "2"]


def test_of_two_forms_of_a_picture_one_is_read(tmp_path):
    write(tmp_path, ["1.png", "2.png", "3.tiff"])
    write(tmp_path, ["1.jpg", "2.JPG", "3.png"], PICTURES[::-1])
    source = open_source(tmp_path, Reading(10.0))
    items = list(source.items())
    assert [(item.name, item.t_ns) for item in items] == [("1", 0), ("2", 10**8), ("3", 2 * 10**8)]
    assert_array_equal([item.image for item in items[:2]], PICTURES[:2])
    assert "3 files are another form of a picture" in source.notes[0]


def test_names_that_are_stamps_are_stamps(tmp_path):
    stamps = [START, START + 50_000_000, START + 100_000_000]
    write(tmp_path, [f"{stamp}.png" for stamp in stamps])
    source = open_source(tmp_path)
    assert [item.t_ns for item in source.items()] == stamps
    replaced = open_source(tmp_path, Reading(fps=3.0))
    assert [item.t_ns for item in replaced.items()] == stamps
    assert "--fps 3 is not used" in replaced.notes[-1]
    write(tmp_path, ["first.png"])
    with refused(tmp_path, "give --fps"):
        open_source(tmp_path)


@pytest.mark.parametrize("header", ["#timestamp [ns],filename", "#timestamp,filename"])
def test_a_camera_of_euroc_is_read(tmp_path, header):
    rows = [f"{START + i},{START + i}.png" for i in range(3)]
    write(tmp_path / "cam0" / "data", [row.split(",")[1] for row in rows])
    (tmp_path / "cam0" / "data.csv").write_text("\r\n".join([header, *rows, ""]))
    (tmp_path / "cam0" / "sensor.yaml").write_text("sensor_type: camera\n")
    source = open_source(tmp_path / "cam0")
    assert [item.t_ns - START for item in source.items()] == [0, 1, 2]
    assert source.camera == tmp_path / "cam0" / "sensor.yaml"


def test_pictures_below_are_hinted_at(tmp_path):
    write(tmp_path / "frames", ["1.png"])
    with refused(tmp_path, "there are some in frames"):
        open_source(tmp_path)


def test_upper_bits_given_as_lower_ones_are_said(tmp_path):
    pixels = np.array([[0, 1 << 4], [4095 << 4, 77 << 4]], np.uint16)
    write(tmp_path, ["1.png"], [pixels])
    with pytest.raises(InputError, match=r"--bits 12: .* are the upper ones of 16; leave --bits out"):
        list(open_source(tmp_path, Reading(1.0, bits=12)).items())
    (item,) = open_source(tmp_path, Reading(1.0)).items()
    assert isinstance(item, Frame)
    assert_array_equal(item.image, pixels)
