from itertools import combinations, permutations

import numpy as np
import pytest
from conftest import assert_close
from scipy.optimize import minimize

from lumidock.evaluation.confusion import worst_confusion

ROLL = np.deg2rad(15.0)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])


def fit(assigned, observed):
    """RMS of the best shift, roll and scale that lay `assigned` (K, 2) over `observed`, by a numeric search."""

    def rms(x):
        c, s = x[1] * np.cos(x[0]), x[1] * np.sin(x[0])
        moved = assigned @ np.array([[c, s], [-s, c]]) + x[2:]
        return np.sqrt(((moved - observed) ** 2).sum(axis=1).mean() + 1e-12)

    bounds = [(-ROLL, ROLL), (0.5, 2.0), (None, None), (None, None)]
    return min(minimize(rms, [0, s, 0, 0], bounds=bounds).fun for s in (0.6, 1.8))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seen", [2, 3, 4])
def test_worst_confusion_agrees_with_a_numeric_search(seen, mirrored, rng):
    p_dock = rng.uniform(-1, 1, (4, 3))
    expected = np.inf
    for subset in combinations(range(4), seen):
        truth = p_dock[list(subset), :2]
        views = [truth * [1, -1], truth * [-1, 1]] if mirrored else [truth]
        for assigned in permutations(range(4), seen):
            if mirrored or assigned != subset:
                expected = min(expected, *(fit(p_dock[list(assigned), :2], view) for view in views))
    assert_close(worst_confusion(p_dock, seen=seen, mirrored=mirrored).residual_m, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("p_dock", "seen", "options", "expected"),
    [
        (SQUARE, 4, {"max_roll_rad": np.pi / 2}, 0.0),  # a quarter turn is the same square
        (SQUARE, 4, {"mirrored": True}, 0.0),
        (SQUARE, 2, {}, 0.0),  # one side is like the other
        (np.outer(range(4), [1, 0, 0]), 3, {}, 0.0),  # one step along an even row
        (SQUARE[:3], 1, {}, 0.0),  # a single light can be any
        (np.vstack([SQUARE, SQUARE[:1] - [0, 0, 5]]), 4, {}, 0.0),  # one light behind another
    ],
)
def test_layouts_that_can_be_confused_exactly(p_dock, seen, options, expected):
    assert_close(worst_confusion(np.asarray(p_dock, float), seen=seen, **options).residual_m, expected, atol=1e-7)


@pytest.mark.parametrize(("size", "alike"), [(0.45, False), (0.55, True)])
def test_a_part_of_half_the_size_is_no_confusion(size, alike):
    triangle = np.array([[0, 0, 0], [2, 0, 0], [0.3, 1.2, 0]])
    p_dock = np.vstack([triangle, size * triangle + [5, 7, 0]])
    assert (worst_confusion(p_dock, seen=3).residual_m < 1e-7) == alike


def test_confusion_grows_with_the_layout_and_forgets_its_place(rng):
    p_dock = rng.uniform(-1, 1, (5, 3))
    one = worst_confusion(p_dock, seen=3).residual_m
    assert one > 0
    assert_close(worst_confusion(3 * p_dock + [5, -2, 9], seen=3).residual_m, 3 * one)


def test_more_roll_never_makes_a_layout_safer(rng):
    p_dock = rng.uniform(-1, 1, (5, 3))
    residuals = [worst_confusion(p_dock, seen=4, max_roll_rad=roll).residual_m for roll in np.linspace(0, np.pi, 8)]
    assert (np.diff(residuals) <= 1e-12).all()
    assert residuals[-1] < residuals[0]


def test_the_confused_lights_are_named(rng):
    p_dock = rng.uniform(-1, 1, (5, 3))
    p_dock[3] = p_dock[1] + [0.001, 0, 0]  # two lights all but in one place are exchanged without a misfit
    found = worst_confusion(p_dock, seen=5)
    assert (found.seen, found.taken_for) == ((0, 1, 2, 3, 4), (0, 3, 2, 1, 4))
