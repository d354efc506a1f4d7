import subprocess
import sys
from fractions import Fraction

import av
import numpy as np
import pytest
from conftest import refused

from lumidock.datatypes import Frame, Unusable
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source

LEVELS = (20, 60, 100, 140, 180, 220)


def write(path, codec="libx264", pix_fmt="yuv420p", pts=range(0, 600, 100), color=(0, 0, 0), options=None):
    """Frames of 64 x 48 px of rising level plus `color` (BGR), with stamps `pts` ms."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options or {"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, pix_fmt
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for level, at in zip(LEVELS, pts, strict=True):
            picture = np.full((48, 64, 3), level, np.uint8) + np.array(color, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, "bgr24").reformat(format=pix_fmt)
            frame.pts, frame.time_base = at, stream.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.mov", "a.ts"])
def test_uneven_stamps_are_kept(tmp_path, name):
    pts = (0, 40, 75, 1000, 1001, 1040)
    items = list(open_source(write(tmp_path / name, pts=pts)).items())
    first = items[0].t_ns  # a transport stream starts where it likes
    off = [item.t_ns - first - 10**6 * at for item, at in zip(items, pts, strict=True)]
    assert np.abs(off).max() <= 10**6 / 90 if name == "a.ts" else off == [0] * 6


@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuvj420p", "gray"])
def test_gray_pictures_are_their_luma_in_full_range(tmp_path, pix_fmt):
    codec = "ffv1" if pix_fmt == "gray" else "libx264"
    items = list(open_source(write(tmp_path / "a.mkv", codec, pix_fmt)).items())
    assert [item.image.shape for item in items] == [(48, 64)] * 6
    assert np.abs([item.image.astype(int) - level for item, level in zip(items, LEVELS, strict=True)]).max() <= 2


def test_color_is_read_unless_it_is_not_needed(tmp_path):
    path = write(tmp_path / "a.mkv", color=(30, 0, 0))
    assert [item.image.shape for item in open_source(path).items()] == [(48, 64, 3)] * 6
    assert [item.image.shape for item in open_source(path, Reading(gray=True)).items()] == [(48, 64)] * 6


@pytest.mark.parametrize("codec", ["ffv1", "libx264"])
def test_a_damaged_video_is_read_as_far_as_it_goes(tmp_path, rng, codec):
    pix_fmt, options = ("bgr0", {"slicecrc": "1", "level": "3"}) if codec == "ffv1" else ("yuv420p", {"g": "1"})
    path = write(tmp_path / "a.mkv", codec, pix_fmt, color=rng.integers(0, 30, (48, 64, 3)), options=options)
    good, wanted = path.read_bytes(), [item.image for item in open_source(path).items()]
    counts = []
    for share in np.linspace(0.3, 0.95, 20):
        at = int(share * len(good))
        path.write_bytes(good[:at])  # a recorder that was killed
        frames = [item for item in open_source(path).items() if isinstance(item, Frame)]
        assert all(np.array_equal(item.image, image) for item, image in zip(frames[:-1], wanted, strict=False))
        counts.append(len(frames))
        path.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
        items = list(open_source(path).items())
        assert len(items) >= 4
        assert all(isinstance(item, Frame | Unusable) for item in items)
    assert counts == sorted(counts)
    assert counts[-1] >= 5


def test_a_playlist_opens_nothing_else(tmp_path):
    write(tmp_path / "real.ts")
    (tmp_path / "list.ts").write_text(
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{tmp_path / 'real.ts'}\n#EXT-X-ENDLIST\n"
    )
    (tmp_path / "concat.mp4").write_text(f"ffconcat version 1.0\nfile {tmp_path / 'real.ts'}\n")
    for name in ("list.ts", "concat.mp4"):
        with refused(tmp_path / name, "not a video"):
            open_source(tmp_path / name)


HIDDEN = """
import sys
from pathlib import Path
sys.modules[sys.argv[1]] = None
from lumidock.errors import InputError
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source
try:
    open_source(Path(sys.argv[2]))
except InputError as error:
    print(error)
"""


@pytest.mark.parametrize(("module", "name", "extra"), [("av", "a.mp4", "video"), ("mcap", "a.mcap", "bag")])
def test_a_missing_library_names_its_extra(tmp_path, module, name, extra):
    (tmp_path / name).touch()
    command = [sys.executable, "-c", HIDDEN, module, str(tmp_path / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith(f"is not installed; pip install 'lumidock[{extra}]'")
