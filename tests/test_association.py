"""Which detection is which light under a prediction."""

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from conftest import assert_close
from numpy.testing import assert_array_equal
from scipy.stats import multivariate_normal
from tracks import BOTH, CAMERA, CONFIG, PLAN, PRIOR, STATION, STEP_NS, M, begun, frames_of, head_on, spots_at

from lumidock import match, track
from lumidock._kernels.tracking import association
from lumidock._kernels.tracking import track as kernel
from lumidock.geometry import se3_inverse
from lumidock.localizer import Localizer


def test_association_names_the_lights_under_a_prediction(rng):
    name_count = 0
    frames = frames_of(
        "approach", "path.start_z_m=11", "path.end_z_m=8", "path.frame_interval_s=0.0666667", "faults.spurious=4"
    )
    localizer = Localizer(STATION, CAMERA)
    for frame in frames:
        order = rng.permutation(len(frame.light))
        d = frame.detections
        keys = ("uv", "radius_px", "flux", "p_light", "p_rear")
        d = replace(d, **{key: getattr(d, key)[order] for key in keys})
        if localizer.locked:
            seen = match.spots(d, PLAN, CONFIG.match)
            ahead = track.predict(localizer.beliefs[0], d.t_ns, CONFIG.track)
            found = track.associate(ahead, seen, PLAN, CONFIG)
            used = np.flatnonzero(found.name >= 0)
            assert_array_equal(frame.light[order][found.name[used]], used)
            name_count += len(used)
        localizer.process_detections(d)
    assert name_count > 0.9 * M * (len(frames) - 3)


def every_naming(m, n):
    """All ways (M,) to name `m` lights with `n` detections, each used once at most."""
    for name in product(range(-1, n), repeat=m):
        used = [i for i in name if i >= 0]
        if len(set(used)) == len(used):
            yield np.array(name)


def naming_cost(name, expected, S, shown, uv, var, like, log_clutter, detect):
    """What a naming costs over "all clutter", by the joint density of all its pixels."""
    used = np.flatnonzero(name >= 0)
    cost = -np.log(1.0 - detect) * ((name < 0) & (shown == 2.0)).sum()
    if len(used):
        rows = np.ravel([[2 * c, 2 * c + 1] for c in used])
        cov = S[np.ix_(rows, rows)] + np.diag(np.repeat(var[name[used]], 2))
        cost -= multivariate_normal(cov=cov).logpdf((uv[name[used]] - expected[used]).ravel())
    return cost + sum(log_clutter - np.log(detect) - like[name[c], 0] for c in used)


def associate(problem, gate=1e12, reach=12.0, max_nodes=1_000_000):
    expected, S, shown, uv, var, like, log_clutter, detect = problem
    m = len(expected)
    names, costs = np.full((8, m), -1, np.int64), np.empty(8)
    layer = np.zeros(m, np.int64)
    foreseen = kernel.Foreseen(expected, S, shown)
    terms = association.Terms(log_clutter, detect, gate, reach, max_nodes)
    found = association.associate(foreseen, layer, uv, var, like, terms, names, costs)
    return found, names, costs


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


def test_association_is_as_good_as_the_best_of_all_namings(rng):
    """Best first, all within reach: by enumeration, with the joint density from scipy."""
    for _ in range(30):
        problem = an_association(rng)
        found, names, costs = associate(problem)
        possible = [name for name in every_naming(4, 5) if not ((name >= 0) & (problem[2] == 0.0)).any()]
        expected = np.array([naming_cost(name, *problem) for name in possible])
        order = np.argsort(expected)
        near = order[expected[order] < expected[order[0]] + 11.9][:8]
        assert found >= len(near)
        assert_close(costs[: len(near)], expected[near], rtol=1e-9, atol=1e-7)
        assert_array_equal(names[0], possible[order[0]])


def test_an_association_that_would_take_too_long_names_nothing(rng):
    found, _, _ = associate(an_association(rng), max_nodes=3)
    assert found == -1


@pytest.mark.parametrize("seed", range(6))
def test_association_names_the_lights_however_wide_the_gates(seed):
    """At six frames a second and with no speed known yet, a dozen spots lie in the gate of every light."""
    frames = frames_of("nominal", "path.start_z_m=19", "path.end_z_m=6", "path.frame_interval_s=0.1667", seed=seed)
    frames = [frame for frame in frames if (frame.light >= 0).sum() >= 8]
    for before, frame in pairwise(frames):
        lights = before.light[before.light >= 0]
        slow = track.slow_states(STATION, None)
        start = track.start(
            se3_inverse(before.T_dock_cam),
            match.light_of(before.light, M),
            before.detections.t_ns,
            match.spots(before.detections, PLAN, CONFIG.match),
            PLAN,
            PRIOR,
            slow,
            CONFIG.track,
        )
        assert start is not None, lights
        seen = match.spots(frame.detections, PLAN, CONFIG.match)
        found = track.associate(track.predict(start, frame.detections.t_ns, CONFIG.track), seen, PLAN, CONFIG)
        used = np.flatnonzero(found.name >= 0)
        assert len(used) >= 4
        assert_array_equal(frame.light[found.name[used]], used)


def test_association_of_pure_clutter_is_worth_nothing(rng):
    belief = track.predict(begun(head_on(), BOTH, rng), STEP_NS, CONFIG.track)
    far = np.array([[60.0, 60.0], [2300.0, 100.0], [100.0, 1900.0]])
    found = track.associate(belief, spots_at(far), PLAN, CONFIG)
    assert (found.name == -1).all()
    assert found.log_evidence < 0.0
