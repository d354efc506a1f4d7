import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lumidock.datatypes import MOSAICS, Frame
from lumidock.picture import developed, encoding_of

LEVELS = {"b": 40, "g": 120, "r": 200}


def mosaic_of(order, size, wide):
    """An evenly coloured picture as a sensor with that filter sees it."""
    mosaic = np.empty(size, np.uint16 if wide else np.uint8)
    for place, letter in enumerate(order.removeprefix("bayer_")):
        mosaic[place // 2 :: 2, place % 2 :: 2] = LEVELS[letter] << (8 if wide else 0)
    return Frame("a", 0, mosaic, encoding=f"{order}{16 if wide else 8}")


@pytest.mark.parametrize("size", [(12, 16), (11, 15), (3, 3)])
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("order", MOSAICS)
def test_a_mosaic_is_developed_into_its_colors(order, wide, size):
    frame = mosaic_of(order, size, wide)
    assert_array_equal(developed(frame), np.broadcast_to([40, 120, 200], (*size, 3)))
    assert encoding_of(frame) == frame.encoding


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3)])
def test_other_pictures_keep_their_upper_bits(shape, rng):
    deep = rng.integers(0, 65536, shape, np.uint16)
    assert_array_equal(developed(Frame("a", 0, deep)), deep // 256)
    plain = (deep // 256).astype(np.uint8)
    assert developed(Frame("a", 0, plain)) is plain
    kinds = [encoding_of(Frame("a", 0, image)) for image in (plain, deep)]
    assert kinds == (["mono8", "mono16"] if len(shape) == 2 else ["bgr8", "bgr16"])


@pytest.mark.parametrize("size", [(1, 1), (2, 8), (8, 2)])
def test_less_than_a_cell_stays_as_it_is(size):
    frame = mosaic_of("bayer_rggb", size, wide=False)
    assert_array_equal(developed(frame), frame.image)
