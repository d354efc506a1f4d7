"""Where samples saturate, a picture may not use its whole range: the level is read from the picture."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lumidock import detect
from lumidock._kernels.detection.saturation import SATURATED
from lumidock.config import DetectConfig
from lumidock.datatypes import Frame

CONFIG = DetectConfig()
PLACES = [(60.3, 60.6), (160.1, 120.7), (260.4, 180.2), (60.8, 180.5)]


def overexposed(rng):
    """Lights with saturated cores of 5 px and halos, in noise, as BGR of the whole range."""
    image = rng.normal(20.0, 1.5, (240, 320, 3))
    rows, columns = np.indices(image.shape[:2])
    for u, v in PLACES:
        square = (columns - u) ** 2 + (rows - v) ** 2
        image += (900.0 * np.exp(-0.5 * square / 3.0**2) + 120.0 * np.exp(-0.5 * square / 9.0**2))[..., None]
    return np.clip(np.rint(image), 0, 255)


def seen(image):
    frame = Frame("f", 7, np.clip(np.rint(image), 0, 255).astype(np.uint8))
    scan = detect.Scan(frame, CONFIG)
    return detect.lights(frame, CONFIG, scan), scan.saturated


@given(share=st.floats(0.7, 1.0), pedestal=st.sampled_from([0.0, 16.0]), seed=st.integers(0, 1000))
def test_a_smaller_range_changes_no_light(share, pedestal, seed):
    full = overexposed(np.random.default_rng(seed))
    image = full * (share - pedestal / 255.0) + pedestal
    found, level = seen(image)
    assert image.max() - 12.0 < level <= np.rint(image.max())
    for place in PLACES:
        distance = np.linalg.norm(found.uv - place, axis=1)
        assert distance.min() < 0.15
        assert found.p_light[distance.argmin()] > 0.5


@pytest.mark.parametrize("count", [1, 7, 25])
def test_lights_that_are_not_saturated_pile_up_nowhere(count, rng):
    image = rng.normal(20.0, 2.0, (480, 640))
    rows, columns = np.indices(image.shape)
    for u, v in rng.uniform((20.0, 20.0), (620.0, 460.0), (count, 2)):
        image += 190.0 * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / 1.3**2)
    assert seen(np.minimum(image, 245.0))[1] == SATURATED


def test_bright_water_is_not_saturated(rng):
    image = rng.normal(200.0, 2.0, (240, 320))
    assert seen(image)[1] == SATURATED
    rows, columns = np.indices(image.shape)
    for u, v in PLACES:
        image += 40.0 * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / 3.0**2)
    assert seen(image)[1] == SATURATED
