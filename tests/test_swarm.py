"""The compiled swarm and the assignment inside it, against scipy and complex numbers."""

import faulthandler

import numpy as np
import pytest
from conftest import assert_close
from numpy.testing import assert_array_equal
from scipy.optimize import linear_sum_assignment

from lumidock._kernels.assignment import assign
from lumidock.paper.swarm import PointSets, Tuning, registration_cost, swarm

LIGHTS = np.array([[-1, 0.55], [1, 0.5], [0.9, -0.6], [-0.8, -0.5], [0.1, 0.9], [0.3, -0.2]])
NEW = np.full_like(LIGHTS, np.nan)  # no previous frame
LOW, HIGH = np.array([-0.3, 0.5, -1, -1]), np.array([0.3, 3.0, 1, 1])


@pytest.fixture
def fails_rather_than_hangs():
    faulthandler.dump_traceback_later(60, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


def total(cost, column):
    rows = np.flatnonzero(column >= 0)
    assert len(rows) == min(cost.shape)
    assert len(np.unique(column[rows])) == len(rows)
    return cost[rows, column[rows]].sum()


@pytest.mark.parametrize("kind", ["uniform", "negative", "ties", "forbidden", "transposed", "sliced"])
def test_assign_is_as_cheap_as_scipy(kind, rng):
    for _ in range(200):
        n, m = rng.integers(1, 10, 2)
        cost = {
            "uniform": lambda n, m: rng.random((n, m)),
            "negative": lambda n, m: rng.normal(size=(n, m)),
            "ties": lambda n, m: rng.integers(0, 3, (n, m)).astype(float),
            "forbidden": lambda n, m: np.where(
                (rng.random((n, m)) < 0.4) & ~np.eye(n, m, dtype=bool), np.inf, rng.random((n, m))
            ),
            "transposed": lambda n, m: rng.random((m, n)).T,
            "sliced": lambda n, m: rng.random((2 * n, m))[::2],
        }[kind](n, m)
        assert_close(total(cost, assign(cost)), cost[linear_sum_assignment(cost)].sum(), atol=1e-12)


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_assign_of_nothing_is_nothing(shape):
    assert_array_equal(assign(np.empty(shape)), np.full(shape[0], -1))


@pytest.mark.usefixtures("fails_rather_than_hangs")
@pytest.mark.parametrize("worst", [np.inf, np.nan])
@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (2, 3)])
def test_assign_says_so_when_no_cost_is_finite(worst, shape):
    cost = np.ones(shape)
    cost[:, 0] = cost[0] = worst
    assert_array_equal(assign(cost), np.full(shape[0], -1))


def test_registration_cost_agrees_with_complex_numbers(rng):
    seen, lights, previous = rng.normal(size=(4, 2)), rng.normal(size=(5, 2)), rng.normal(size=(5, 2))
    previous[[1, 3]] = np.nan
    theta, s, tx, ty = x = np.array([0.3, 1.7, 0.2, -0.4])
    z = s * np.exp(1j * theta) * (seen @ [1, 1j])[:, None] + tx + 1j * ty
    expected = 2.0 * abs(z - lights @ [1, 1j]) + np.nan_to_num(0.3 * abs(z - previous @ [1, 1j]))
    assert_close(registration_cost(x, PointSets(seen, lights, previous, np.nan), 2.0, 0.3), expected)


def fly(seen, rng, *, previous=NEW, theta_previous=np.nan, size=(80, 120, 12), trace=None):
    trace = np.full((size[1], size[0], 5), np.nan) if trace is None else trace
    weights = {"w1": 1.0, "w2": 0.3, "penalty": 0.5, "inertia": 0.7, "k": 0.8}
    falling = {"c1_base": 2.5, "c1_final": 0.5, "c2_base": 1.5, "c2_final": 0.5}
    effort = {"particles": size[0], "iterations": size[1], "patience": size[2], "all_pairs": False}
    sets = PointSets(seen, LIGHTS, previous, theta_previous)
    return swarm(sets, Tuning(LOW, HIGH, **weights, **falling, **effort), rng, trace)


def moved(points, theta, s, tx, ty):
    z = s * np.exp(1j * theta) * (points @ [1, 1j]) + tx + 1j * ty
    return np.column_stack([z.real, z.imag])


@pytest.mark.parametrize("theta_previous", [np.nan, 0.0, 0.25, -0.6])
@pytest.mark.parametrize("previous", [NEW, LIGHTS + 0.05], ids=["first frame", "later frame"])
def test_swarm_reports_the_cost_of_what_it_returns(theta_previous, previous, rng):
    seen = rng.normal(size=(5, 2))
    x, fitness = fly(seen, rng, previous=previous, theta_previous=theta_previous, size=(20, 10, 3))
    assert (x >= LOW).all()
    assert (x <= HIGH).all()
    cost = registration_cost(x, PointSets(seen, LIGHTS, previous, np.nan), 1.0, 0.3)
    turned_deg = np.rad2deg(abs(x[0] - theta_previous))
    penalty = 0.5 * (1 + (turned_deg - 10) / 5) if turned_deg >= 10 else 0.0
    assert_close(fitness, cost[linear_sum_assignment(cost)].sum() + penalty)


@pytest.mark.parametrize("n", [4, 6])
def test_swarm_finds_a_known_transform(n, rng):
    truth = np.array([0.12, 1.6, 0.15, -0.1])
    order = rng.permutation(len(LIGHTS))[:n]
    theta, s, tx, ty = truth
    back = np.exp(-1j * theta) * (LIGHTS[order] @ [1, 1j] - tx - 1j * ty) / s
    seen = np.column_stack([back.real, back.imag])
    x, fitness = fly(seen, rng)
    assert_close(x, truth, atol=0.02)
    assert fitness < 0.02 * n
    assert_array_equal(assign(registration_cost(x, PointSets(seen, LIGHTS, NEW, np.nan), 1.0, 0.3)), order)


def test_swarm_is_decided_by_its_seed(rng):
    seen, seed = rng.normal(size=(5, 2)), rng.integers(2**32)
    one, again, other = (fly(seen, np.random.default_rng(s), size=(20, 10, 3))[0] for s in (seed, seed, seed + 1))
    assert_array_equal(one, again)
    assert (one != other).any()


def test_a_longer_flight_is_never_worse(rng):
    seen = rng.normal(size=(5, 2))
    scores = [fly(seen, np.random.default_rng(1), size=(20, n, 3))[1] for n in (1, 1000)]
    assert scores[1] < scores[0]


def test_the_trace_holds_every_particle_and_changes_nothing():
    seen = LIGHTS[:5] * 0.8 + 0.1
    trace = np.full((30, 20, 5), np.nan)
    x, fitness = fly(seen, np.random.default_rng(3), size=(20, 30, 6), trace=trace)
    bare, _ = fly(seen, np.random.default_rng(3), size=(20, 30, 6), trace=np.empty((0, 0, 5)))
    assert_array_equal(x, bare)
    assert fitness == trace[..., 4].min()
    assert_array_equal(x, trace.reshape(-1, 5)[trace[..., 4].argmin(), :4])
    assert (trace[..., :4] >= LOW).all()
    assert (trace[..., :4] <= HIGH).all()
