"""Surveys: the adjustment against exact data and finite differences, whole surveys against docks of known shape."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench.built_docks import BuiltDock, built_dock, shape_error, taped
from hypothesis import given, settings
from hypothesis import strategies as st

from lumidock.camera import Camera, load_camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections
from lumidock.errors import InputError
from lumidock.geometry import se3_exp, so3_exp
from lumidock.setup import bundle
from lumidock.setup.advice import helpful_views
from lumidock.setup.bundle import CALIBRATION, Distance, Estimate, Prior
from lumidock.setup.gauge import aligned, scale_sigma, shape_covariance, similarity_generators
from lumidock.setup.moved import moves
from lumidock.setup.observations import Labelled, Observations, identify
from lumidock.setup.station_files import write_surveyed
from lumidock.setup.survey import Survey, prior_of, survey
from lumidock.station import load_station

REAL = Path(__file__).parents[2] / "shared" / "real"


def _surveyed(dock: BuiltDock, *, tape: bool = True) -> Survey:
    distances = (Distance(*taped(dock, "F1", "R5"), 0.002),) if tape else ()
    prior = prior_of(dock.drawing, distances=distances)
    return survey(dock.recordings, dock.drawing, dock.camera, Config(), prior)


@pytest.fixture(scope="module")
def dock() -> BuiltDock:
    return built_dock(3)


@pytest.fixture(scope="module")
def found(dock: BuiltDock) -> Survey:
    return _surveyed(dock)


def _scene(seed: int, frames: int = 6, noise_px: float = 0.0) -> tuple[Camera, Array, Array, Observations]:
    rng = np.random.default_rng(seed)
    camera = Camera(
        1000,
        800,
        np.array([[700.0, 0, 500], [0, 710.0, 400], [0, 0, 1]]),
        "plumb_bob",
        np.array([-0.1, 0.02, 1e-3, -5e-4, 0.0]),
    )
    p_dock = rng.uniform(-1.0, 1.0, (8, 3)) * [1.0, 1.0, 0.8]
    T = np.array(
        [
            np.diag([1.0, -1, -1, 1]) @ se3_exp(rng.normal(size=6) * [0.5, 0.5, 0.5, 0.1, 0.1, 0.1])
            for _ in range(frames)
        ]
    )
    T[:, :3, 3] += [0.0, 0.0, 4.0]
    p_cam = (p_dock[None] - T[:, None, :3, 3]) @ T[:, :3, :3]
    uv = camera.project(p_cam.reshape(-1, 3)).reshape(frames, 8, 2) + rng.normal(size=(frames, 8, 2)) * noise_px
    names = tuple(map(str, range(frames)))
    zeros = np.zeros(frames, np.int64)
    return camera, p_dock, T, Observations(uv, np.full((frames, 8), 0.5), zeros, np.arange(frames), names)


def test_information_agrees_with_finite_differences_of_the_pixels():
    camera, p_dock, T, observed = _scene(1, frames=3)
    calibration = np.array([0.01, 1.5, -2.0, 0.02, -0.01])

    def pixels(x: Array) -> Array:
        m3 = p_dock.size
        moved = np.array([t @ se3_exp(xi) for t, xi in zip(T, x[m3 + CALIBRATION :].reshape(-1, 6), strict=True)])
        p_cam = (p_dock + x[:m3].reshape(-1, 3) - moved[:, None, :3, 3]) @ moved[:, :3, :3]
        away = camera.project(p_cam.reshape(-1, 3)) - camera.center_px
        focal, du, dv, k1, k2 = calibration + x[m3 : m3 + CALIBRATION]
        r2 = ((away / camera.focal_px) ** 2).sum(axis=1, keepdims=True)
        return (away * (1.0 + focal + k1 * r2 + k2 * r2**2) + camera.center_px + [du, dv]).ravel()

    n = p_dock.size + CALIBRATION + 6 * len(T)
    J = np.array([(pixels(h) - pixels(-h)) / 2e-6 for h in 1e-6 * np.eye(n)]).T
    H = J.T @ J / 0.5**2
    s = p_dock.size + CALIBRATION
    expected = H[:s, :s] - H[:s, s:] @ np.linalg.solve(H[s:, s:], H[s:, :s])
    got = bundle.information(observed, camera, Estimate(p_dock, T, calibration))
    np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())


def test_exact_pixels_give_the_exact_shape():
    camera, p_dock, T, observed = _scene(2, frames=10)
    drawn = p_dock + np.random.default_rng(5).normal(size=p_dock.shape) * 0.03
    prior = Prior(drawn, np.full(p_dock.shape, 0.05), 1e-6, 1e-4)
    start, _ = bundle.refine_poses(observed, camera, drawn, T, observed.sigma_px)
    got = bundle.adjust(observed, camera, prior, Estimate(drawn, start, np.zeros(CALIBRATION))).estimate
    assert np.abs(aligned(got.p_dock, p_dock, scale=True) - p_dock).max() < 2e-4


def test_the_stated_errors_are_those_of_many_draws():
    chi2, dof = [], 0
    for seed in range(25):
        camera, p_dock, T, observed = _scene(100 + seed, frames=30, noise_px=0.5)
        drawn = p_dock + np.random.default_rng(seed).normal(size=p_dock.shape) * 0.02
        prior = Prior(drawn, np.full(p_dock.shape, 0.02), 1e-6, 1e-4)
        got = bundle.adjust(observed, camera, prior, Estimate(drawn, T, np.zeros(CALIBRATION)))
        seen = np.ones(8, bool)
        e = shape_error(got.estimate.p_dock, p_dock, seen, scale=True).ravel()
        C = shape_covariance(got.covariance, got.estimate.p_dock, seen)
        chi2.append(float(e @ np.linalg.pinv(C, rcond=1e-9) @ e))
        dof = p_dock.size - 7
    # 25 draws of 17 degrees of freedom: the 99.9 % band of their mean is 0.78-1.25
    assert 0.75 < np.mean(chi2) / dof < 1.3


def test_wild_detections_are_set_aside():
    camera, p_dock, T, observed = _scene(7, frames=40, noise_px=0.3)
    rng = np.random.default_rng(1)
    wild = rng.random(observed.seen.shape) < 0.03
    uv = observed.uv + wild[..., None] * rng.uniform(20.0, 80.0, observed.uv.shape)
    drawn = p_dock + rng.normal(size=p_dock.shape) * 0.02
    prior = Prior(drawn, np.full(p_dock.shape, 0.05), 1e-6, 1e-4)
    got = bundle.adjust(replace(observed, uv=uv), camera, prior, Estimate(drawn, T, np.zeros(CALIBRATION)))
    assert not (got.used & wild).any()
    assert np.sqrt((shape_error(got.estimate.p_dock, p_dock, np.ones(8, bool), scale=True) ** 2).mean()) < 2e-3


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.2, 5.0))
def test_alignment_undoes_any_similarity(seed: int, size: float):
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(6, 3))
    moved = size * p @ so3_exp(rng.normal(size=3)).T + rng.normal(size=3)
    np.testing.assert_allclose(aligned(moved, p, scale=True), p, atol=1e-9)


def test_the_shape_has_no_error_along_what_pictures_cannot_tell():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(7, 3))
    G = similarity_generators(p)
    C = shape_covariance(np.eye(21), p, np.ones(7, bool))
    assert np.abs(G.T @ C @ G).max() < 1e-12
    assert np.linalg.matrix_rank(C, tol=1e-9) == 21 - 7
    grown = 0.01**2 * np.outer(p - p.mean(axis=0), p - p.mean(axis=0))
    assert scale_sigma(grown, p, np.ones(7, bool)) == pytest.approx(0.01)


def test_a_dock_five_centimetres_off_is_surveyed_to_millimetres(dock: BuiltDock, found: Survey):
    seen = found.adjusted.used.any(axis=0)
    assert found.refusal == ""
    assert seen.sum() >= 11
    before = shape_error(dock.drawing.p_dock, dock.built.p_dock, seen, scale=False)[seen]
    after = shape_error(found.after.p_dock, dock.built.p_dock, seen, scale=False)[seen]
    assert np.sqrt((before**2).mean()) > 0.03
    assert np.sqrt((after**2).mean()) < 0.004
    assert found.held_out_px[1] < 0.8 < 10.0 < found.held_out_px[0]


def test_the_survey_knows_how_good_it_is(dock: BuiltDock, found: Survey):
    seen = found.adjusted.used.any(axis=0)
    e = shape_error(found.after.p_dock, dock.built.p_dock, seen, scale=True)[seen].ravel()
    C = found.covariance[np.ix_(np.repeat(seen, 3), np.repeat(seen, 3))]
    nees = float(e @ np.linalg.pinv(C, rcond=1e-9) @ e) / (len(e) - 7)
    assert 0.3 < nees < 2.0  # one draw of about 30 degrees of freedom, 99.99 %
    assert 0.0 < ((e.reshape(-1, 3) / found.sigma_m[seen]) ** 2).mean() < 3.0


def test_without_a_distance_the_survey_says_that_the_size_is_unknown(dock: BuiltDock):
    assert any("size" in text for text in _surveyed(dock, tape=False).unobserved)


def test_a_light_that_is_never_seen_stays_as_drawn(dock: BuiltDock):
    dark = dock.drawing.ids.index("F2")
    without = [
        [_only(d, light != dark) for d, light in zip(*pair, strict=True)]
        for pair in zip(dock.recordings, dock.lights, strict=True)
    ]
    got = _surveyed(replace(dock, recordings=without))
    assert any("F2" in text for text in got.unobserved)
    assert np.sqrt((got.sigma_m[dark] ** 2).mean()) > 0.04
    assert np.abs(got.after.p_dock[dark] - dock.drawing.p_dock[dark]).max() < 0.05


def _only(d: Detections, keep: np.ndarray) -> Detections:
    return Detections(d.frame, d.t_ns, *(getattr(d, f)[keep] for f in ("uv", "radius_px", "flux", "p_light", "p_rear")))


def test_the_file_that_is_written_is_read_back_with_its_sigmas(tmp_path: Path, found: Survey):
    shipped = Path(bundle.__file__).parents[1] / "stations" / "cage-2x2x5.yaml"
    write_surveyed(shipped, tmp_path / "dock.yaml", found.after, found.sigma_m, name="mine", about="two\nlines")
    again = load_station(tmp_path / "dock.yaml")
    assert again.ids == found.after.ids
    np.testing.assert_allclose(again.p_dock, found.after.p_dock, atol=5.1e-5)
    assert (np.asarray(again.sigma_light_m) >= found.sigma_m.max(axis=1) - 1e-12).all()
    assert (np.asarray(again.sigma_light_m) <= found.sigma_m.max(axis=1) + 1.1e-4).all()
    assert again.sigma_layer_m == 0.0


def test_a_light_that_moved_since_is_found(found: Survey, dock: BuiltDock):
    filed = replace(found.after, sigma_light_m=0.05, sigma_layer_m=0.0)
    shifted = filed.p_dock.copy()
    shifted[filed.ids.index("F5")] += [0.0, 0.06, 0.0]
    filed = replace(filed, p_dock=shifted)
    later = survey(dock.recordings, filed, dock.camera, Config(), prior_of(filed))
    compared = moves(later, found.sigma_m)
    assert [filed.ids[i] for i in np.flatnonzero(compared.moved)] == ["F5"]
    assert compared.by_m[filed.ids.index("F5"), 1] == pytest.approx(-0.06, abs=0.01)


def _labels(dock: BuiltDock, places: tuple[int, ...]) -> list[Labelled]:
    """What a person who knows the lights says of some frames of the first recording."""
    shown = [(dock.recordings[0][k], dock.lights[0][k]) for k in places]
    return [Labelled(d.frame, tuple(d.uv[i]), int(light[i])) for d, light in shown for i in np.flatnonzero(light >= 0)]


def test_labels_of_three_frames_bring_in_a_light_that_is_drawn_far_off(dock: BuiltDock):
    far = dock.drawing.ids.index("F5")
    p = dock.drawing.p_dock.copy()
    p[far, 0] += 0.4  # eight of the sigmas that are stated
    drawing, one = replace(dock.drawing, p_dock=p), [dock.recordings[0][::2]]
    prior = prior_of(drawing, distances=(Distance(*taped(dock, "F1", "R5"), 0.002),))
    count = len(one[0])
    labels = _labels(dock, tuple(2 * k for k in (count // 2, 2 * count // 3, 5 * count // 6)))
    assert identify(one, drawing, dock.camera, Config()).seen[:, far].mean() < 0.1
    told = survey(one, drawing, dock.camera, Config(), prior, labels=labels)
    error = shape_error(told.after.p_dock, dock.built.p_dock, told.adjusted.seen, scale=False)[far]
    assert told.observed.seen[:, far].mean() > 0.5
    assert np.linalg.norm(error) < 0.02
    frame = told.observed.frame.index(labels[-1].frame)
    assert set(np.flatnonzero(told.observed.seen[frame])) <= {
        label.light for label in labels if label.frame == labels[-1].frame
    }


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda labels: [replace(labels[0], frame="nowhere")], "frame nowhere: labelled, but not in the recording"),
        (lambda labels: [replace(labels[0], uv=(-50.0, 3.0)), *labels[1:]], "no detection at -50.0, 3.0 px"),
        (lambda labels: labels[:3], "3 lights labelled, wanted at least 4"),
    ],
)
def test_labels_of_what_is_not_there_are_refused(dock: BuiltDock, change, why: str):
    labels = _labels(dock, (len(dock.recordings[0]) // 2,))
    with pytest.raises(InputError, match=why):
        survey(dock.recordings[:1], dock.drawing, dock.camera, Config(), prior_of(dock.drawing), labels=change(labels))


def test_footage_of_another_dock_is_refused(dock: BuiltDock):
    rng = np.random.default_rng(0)
    other = replace(dock.drawing, p_dock=dock.drawing.p_dock + rng.normal(size=(13, 3)) * [0.5, 0.5, 0.2])
    few = [dock.recordings[0][60:100]]
    assert "another dock" in survey(few, other, dock.camera, Config(), prior_of(other)).refusal


def test_footage_that_shows_hardly_any_light_is_refused(dock: BuiltDock):
    with pytest.raises(InputError, match="frames with four or more identified lights"):
        survey([dock.recordings[0][:3]], dock.drawing, dock.camera, Config(), prior_of(dock.drawing))


def test_advice_is_a_view_that_shows_lights_and_helps(dock: BuiltDock, found: Survey):
    views = helpful_views(found, dock.camera)
    assert views
    assert all(view.lights >= 4 and 0.0 < view.share <= 1.0 for view in views)
    assert views[0].share <= views[-1].share


@pytest.mark.skipif(not (REAL / "pool-ring").is_dir(), reason="real frames are not beside the checkout")
def test_a_real_ring_is_surveyed_from_its_drawing():
    drawing = load_station(REAL / "pool-ring" / "station_drawing.yaml")
    refined = load_station(REAL / "pool-ring" / "station.yaml")
    camera = load_camera(REAL / "pool-ring" / "camera.yaml")
    recordings = [_reference(REAL / name) for name in ("pool-ring", "pool-ring-2")]
    got = survey(recordings, drawing, camera, Config(), prior_of(drawing))
    assert got.refusal == ""
    assert got.held_out_px[1] / np.sqrt(2.0) < 0.40 < 1.9 < got.held_out_px[0] / np.sqrt(2.0)
    moved = aligned(got.after.p_dock, refined.p_dock, scale=True) - refined.p_dock
    assert np.linalg.norm(moved[:, :2], axis=1).max() < 0.010


def _reference(folder: Path) -> list[Detections]:
    with (folder / "timestamps.csv").open() as file:
        stamps = {row["frame"]: int(row["t_ns"]) for row in csv.DictReader(file)}
    rows: dict[str, list[tuple[float, float]]] = {}
    with (folder / "reference_lights.csv").open() as file:
        for row in csv.DictReader(file):
            rows.setdefault(row["frame"], []).append((float(row["u_px"]), float(row["v_px"])))
    return [Detections.from_uv(f, t, np.array(rows[f])) for f, t in stamps.items() if f in rows]
