"""A picture that repeats is told from the next one of a camera that stands still."""

import numpy as np
import pytest

from lumidock.digest import Digest


def pictures(rng, count, noise):
    scene = rng.integers(20, 200, (240, 320)).astype(float)
    return [np.clip(scene + rng.normal(0.0, noise, scene.shape), 0, 255).astype(np.uint8) for _ in range(count)]


def digests(images):
    found = [Digest.of(images[0])]
    for image in images[1:]:
        found.append(found[-1].next(image))
    return found


@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_a_camera_that_stands_still_does_not_repeat(rng, noise):
    assert not any(one.repeats for one in digests(pictures(rng, 30, noise)))


def test_a_repeated_picture_is_told_exactly_and_after_a_decoder(rng):
    seen = pictures(rng, 6, 3.0)
    decoded = np.clip(seen[-1].astype(float) + rng.normal(0.0, 0.3, seen[-1].shape), 0, 255).astype(np.uint8)
    found = digests([*seen, seen[-1], decoded, *pictures(rng, 1, 3.0)])
    assert [one.repeats for one in found] == [False] * 6 + [True, True, False]


def test_pictures_without_noise_prove_nothing():
    dark = [np.zeros((100, 100, 3), np.uint8)] * 5
    assert not any(one.repeats for one in digests(dark))


def test_a_picture_of_another_size_begins_anew(rng):
    first = Digest.of(pictures(rng, 1, 2.0)[0])
    other = first.next(np.zeros((50, 60), np.uint16))
    assert not other.repeats
    assert np.isnan(other.usual)
