"""Which detection is which light under a prediction."""

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from conftest import assert_close
from numpy.testing import assert_array_equal
from scipy.stats import multivariate_normal
from tracks import BOTH, CAMERA, CONFIG, MODEL, STATION, STEP_NS, M, begun, frames_of, head_on, measured, start

from lumidock import track
from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking import association
from lumidock._kernels.tracking import track as kernel
from lumidock.geometry import se3_inverse
from lumidock.localizer import Localizer
from lumidock.model import light_of, measurements


def test_association_identifies_the_lights_under_a_prediction(rng):
    identified = 0
    frames = frames_of(
        "approach", "path.start_z_m=11", "path.end_z_m=8", "path.frame_interval_s=0.0666667", "faults.spurious=4"
    )
    localizer = Localizer(STATION, CAMERA)
    for frame in frames:
        order = rng.permutation(len(frame.light))
        d = frame.detections
        keys = ("uv", "radius_px", "flux", "p_light", "p_rear")
        d = replace(d, **{key: getattr(d, key)[order] for key in keys})
        if localizer.state.confirmed:
            seen = measurements(d, MODEL, CONFIG.match)
            ahead = track.predict(localizer.state.first, d.t_ns, CONFIG.track)
            found = track.associate(ahead, seen, MODEL, CONFIG)
            used = np.flatnonzero(found.assignment >= 0)
            assert_array_equal(frame.light[order][found.assignment[used]], used)
            identified += len(used)
        localizer.process_detections(d)
    assert identified > 0.9 * M * (len(frames) - 3)


def every_assignment(m, n):
    """All ways (M,) to assign `n` detections to `m` lights, each used once at most."""
    for assignment in product(range(-1, n), repeat=m):
        used = [i for i in assignment if i >= 0]
        if len(set(used)) == len(used):
            yield np.array(assignment)


def assignment_cost(assignment, expected, S, shown, uv, var, like, log_clutter, detect):
    """What an assignment costs over "all clutter", by the joint density of all its pixels."""
    used = np.flatnonzero(assignment >= 0)
    cost = -np.log(1.0 - detect) * ((assignment < 0) & (shown == 2.0)).sum()
    if len(used):
        rows = np.ravel([[2 * c, 2 * c + 1] for c in used])
        cov = S[np.ix_(rows, rows)] + np.diag(np.repeat(var[assignment[used]], 2))
        cost -= multivariate_normal(cov=cov).logpdf((uv[assignment[used]] - expected[used]).ravel())
    return cost + sum(log_clutter - np.log(detect) - like[assignment[c], 0] for c in used)


def associate(problem, gate=1e12, reach=12.0, max_nodes=1_000_000):
    expected, S, shown, uv, var, like, log_clutter, detect = problem
    m = len(expected)
    ranking = association.Ranking(np.full((8, m), -1, np.int64), np.empty(8))
    predicted = kernel.PredictedMeasurements(expected, S, shown)
    cov = var[:, None, None] * np.eye(2)
    frame = Measurements(uv, cov, var, like, np.ones(len(uv)), log_clutter)
    terms = association.Terms(detect, gate, reach, max_nodes)
    found = association.associate(predicted, np.zeros(m, np.int64), frame, terms, ranking)
    return found, *ranking


def an_association(rng, m=4, n=5):
    """Lights under a prediction whose errors are mostly common to all, some of the detections theirs."""
    common, own = rng.normal(0, 30, (2 * m, 3)), rng.normal(0, 1, (2 * m, 2 * m))
    S = common @ common.T + 0.3 * own @ own.T
    expected = rng.uniform(300, 500, (m, 2))
    uv = rng.uniform(250, 550, (n, 2))
    seen = rng.permutation(m)[: rng.integers(1, m + 1)]
    uv[: len(seen)] = (expected + rng.multivariate_normal(np.zeros(2 * m), S).reshape(m, 2))[seen]
    shown = rng.choice([0.0, 1.0, 2.0], m, p=[0.1, 0.3, 0.6])
    return expected, S, shown, uv, rng.uniform(0.1, 2.0, n), rng.normal(0, 0.5, (n, 1)), -11.0, 0.8


def test_association_is_as_good_as_the_best_of_all_assignments(rng):
    """Best first, all within reach: by enumeration, with the joint density from scipy."""
    for _ in range(30):
        problem = an_association(rng)
        found, assignments, costs = associate(problem)
        possible = [
            assignment for assignment in every_assignment(4, 5) if not ((assignment >= 0) & (problem[2] == 0.0)).any()
        ]
        expected = np.array([assignment_cost(assignment, *problem) for assignment in possible])
        order = np.argsort(expected)
        near = order[expected[order] < expected[order[0]] + 11.9][:8]
        assert found >= len(near)
        assert_close(costs[: len(near)], expected[near], rtol=1e-9, atol=1e-7)
        assert_array_equal(assignments[0], possible[order[0]])


def test_an_association_that_would_take_too_long_assigns_nothing(rng):
    found, _, _ = associate(an_association(rng), max_nodes=3)
    assert found == -1


@pytest.mark.parametrize("seed", range(6))
def test_association_identifies_the_lights_however_wide_the_gates(seed):
    """At six frames a second and with no speed known yet, a dozen detections lie in the gate of every light."""
    frames = frames_of("nominal", "path.start_z_m=19", "path.end_z_m=6", "path.frame_interval_s=0.1667", seed=seed)
    frames = [frame for frame in frames if (frame.light >= 0).sum() >= 8]
    for before, frame in pairwise(frames):
        lights = before.light[before.light >= 0]
        first = measurements(before.detections, MODEL, CONFIG.match)
        begun_there = start(se3_inverse(before.T_dock_cam), light_of(before.light, M), first, before.detections.t_ns)
        assert begun_there is not None, lights
        seen = measurements(frame.detections, MODEL, CONFIG.match)
        found = track.associate(track.predict(begun_there, frame.detections.t_ns, CONFIG.track), seen, MODEL, CONFIG)
        used = np.flatnonzero(found.assignment >= 0)
        assert len(used) >= 4
        assert_array_equal(frame.light[found.assignment[used]], used)


def test_association_of_pure_clutter_is_worth_nothing(rng):
    one = track.predict(begun(head_on(), BOTH, rng), STEP_NS, CONFIG.track)
    far = np.array([[60.0, 60.0], [2300.0, 100.0], [100.0, 1900.0]])
    found = track.associate(one, measured(far), MODEL, CONFIG)
    assert (found.assignment == -1).all()
    assert found.log_evidence < 0.0
