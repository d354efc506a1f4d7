"""What was there in the frame before looks more like a lamp, and what was not less: snow, jumping reflections."""

import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock import detect
from lumidock.config import DetectConfig
from lumidock.datatypes import Frame
from lumidock.localizer import Localizer

CONFIG = DetectConfig()
STEP_NS = 66_000_000
SPOTS = np.array([[60.0, 60.0], [160.0, 120.0], [260.0, 180.0]])


def picture(rng, uv, peak=60.0):
    """Spots of 1.5 px in noise, at whole or broken pixels; `peak` for all or for each."""
    image = rng.normal(20.0, 3.0, (240, 320))
    rows, columns = np.indices(image.shape)
    for (u, v), height in zip(uv, np.broadcast_to(peak, len(uv)), strict=True):
        image += height * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / 1.5**2)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def likely(found, uv):
    """`p_light` of the spot at each place."""
    distance = np.linalg.norm(found.uv[:, None] - np.asarray(uv)[None], axis=2)
    assert (distance.min(axis=0) < 1.0).all()
    return found.p_light[distance.argmin(axis=0)]


def odds(p):
    return p / (1.0 - p)


def film(rng, gap_ns, *moments):
    """`p_light` of the spots of the last of these moments (uv, peaks), with and without those before it."""
    scan = detect.Scan(Frame("0", 0, picture(rng, SPOTS)), CONFIG)
    frames = [Frame(str(k), k * gap_ns, picture(rng, *moment)) for k, moment in enumerate(moments)]
    found = [detect.lights(frame, CONFIG, scan) for frame in frames]
    return likely(found[-1], moments[-1][0]), likely(detect.lights(frames[-1], CONFIG), moments[-1][0])


@pytest.mark.parametrize("way", [(0.0, 0.0), (8.0, -5.0), (-20.0, 12.0)])
def test_a_spot_that_moves_with_the_vehicle_gains_and_a_new_one_loses(way, rng):
    peaks = rng.uniform(12.0, 60.0, 3)
    new = (140.0, 40.0)
    after, alone = film(rng, STEP_NS, (SPOTS, peaks), (np.vstack([SPOTS + way, new]), [*peaks, 60.0]))
    assert (after[:3] >= alone[:3]).all()
    assert (after[:3] > alone[:3]).any()
    assert odds(after[3]) < 0.1 * odds(alone[3])


def test_a_spot_whose_flux_jumps_is_no_continuation(rng):
    after, alone = film(rng, STEP_NS, (SPOTS, 20.0), (SPOTS, (20.0, 20.0, 120.0)))
    assert (after[:2] >= alone[:2]).all()
    assert after[2] < alone[2]


@pytest.mark.parametrize("gap_ns", [0, -STEP_NS, 1_000_000_000])
def test_a_frame_that_is_too_old_or_not_before_says_nothing(gap_ns, rng):
    after, alone = film(rng, gap_ns, (SPOTS[:1], 60.0), (SPOTS, 60.0))
    assert (after == alone).all()


def test_a_tracked_search_holds_nothing_against_what_it_did_not_look_at(rng):
    image = picture(rng, SPOTS)
    scan = detect.Scan(Frame("0", 0, image), CONFIG)
    detect.lights(Frame("0", 0, picture(rng, SPOTS[:1])), CONFIG, scan)
    expected = np.array([[*SPOTS[0], 12.0]])
    frames = [Frame(str(k), k * STEP_NS, image) for k in range(1, 2 * detect.SWEEP)]
    seen = (detect.lights(frame, CONFIG, scan, expected) for frame in frames)
    first = next(found for found in seen if len(found) == len(SPOTS))
    assert (likely(first, SPOTS) > 0.9).all()


def test_a_cold_localizer_forgets_which_spots_were_there(rng):
    camera = shipped_camera()
    image = np.full((camera.height, camera.width), 20, np.uint8)
    image[:240, :320] = picture(rng, SPOTS)
    blank = np.full_like(image, 20)
    cold = Localizer(shipped_station(), camera, cold=True)
    alone = cold.process(Frame("0", 0, image)).match.detections.p_light
    cold.process(Frame("1", STEP_NS, blank))
    assert (cold.process(Frame("2", 2 * STEP_NS, image)).match.detections.p_light == alone).all()


def test_a_localizer_that_forgets_does_so_in_the_picture_too(rng):
    camera = shipped_camera()
    image = np.full((camera.height, camera.width), 20, np.uint8)
    blank = image.copy()
    image[:240, :320] = picture(rng, SPOTS)
    localizer = Localizer(shipped_station(), camera)
    alone = localizer.process(Frame("0", 0, image)).match.detections.p_light
    localizer.process(Frame("1", STEP_NS, blank))
    localizer.forget()
    assert (localizer.process(Frame("2", 2 * STEP_NS, image)).match.detections.p_light == alone).all()
