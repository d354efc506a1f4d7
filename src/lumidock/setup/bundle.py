"""Bundle adjustment of a dock: light positions, the pose of every frame and the camera's main errors together.

Robust sparse least squares. The poses are eliminated (Schur complement: B. Triggs et al., "Bundle Adjustment - A
Modern Synthesis", 2000), so that a step costs as much as there are lights, not frames. F frames, M lights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.setup.observations import LEAST_LIGHTS, Observations

CALIBRATION = (
    5  # relative focal error; shift of the principal point u, v px; radial distortion beyond the file's k1, k2
)
_CAUCHY = 3.0  # sigmas at which a residual counts half; costs 5 % of efficiency on Gaussian noise
_OUTLIER = 4.0  # sigmas beyond which a detection says nothing; 1 in 3000 by chance in two dimensions
_MEDIAN_CHI2 = 1.386  # of two degrees of freedom
_MOST_STEPS, _CONVERGED = 60, 1e-5  # Levenberg-Marquardt; relative fall of the cost
_BELIEVED = 4.0  # sigmas that a calibration may leave its prior
_FIRST_DAMPING, _MOST_DAMPING = 1e-4, 1e8
_OPEN = 1e-9  # information 1/m^2, 1/rad^2 on a pose that nothing else holds; no frame's own comes near it
_LEAST_NOISE = 0.1  # of the stated error: no detector is so much better than it says
_ENOUGH = 60  # residuals of a light from which its own noise is judged; below, that of all lights holds


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance of `metres` between the lights with indices `a` and `b`, measured to `sigma_m`."""

    a: int
    b: int
    metres: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known before: positions `p_dock` (M, 3) to `sigma_m` (M, 3), distances, and how good the camera is."""

    p_dock: Array
    sigma_m: Array
    sigma_focal: float
    sigma_center_px: float
    sigma_distortion: float = 0.0
    distances: tuple[Distance, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Light positions `p_dock` (M, 3), poses `T_dock_cam` (F, 4, 4), `calibration` (3,): relative focal, du, dv px."""

    p_dock: Array
    T_dock_cam: Array
    calibration: Array


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The outcome: the estimate, `covariance` (3M + 3, 3M + 3) of positions and calibration with the poses eliminated.

    `residual_px` (F, M, 2), NaN where unseen; `noise` (M,) by what factor each light's centres scatter
    more than their stated errors; `used` (F, M)
    the detections that agree; `repeats` how many successive frames carry the information of one, because their errors
    are alike; `calibrated`: whether the calibration was adjusted, not kept.
    """

    estimate: Estimate
    covariance: Array
    residual_px: Array
    noise: Array
    used: np.ndarray
    repeats: float
    calibrated: bool

    @property
    def seen(self) -> np.ndarray:
        """Which lights (M,) have any detection that agrees."""
        return np.asarray(self.used.any(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """Residuals (F, M, 2) px and Jacobians of the pixels by pose (.., 6), position (.., 3) and calibration (.., 3)."""

    residual: Array
    J_pose: Array
    J_light: Array
    J_calibration: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations with the poses apart: A (F, 6, 6), B (F, 6, S), C (S, S), gradients a (F, 6), c (S,)."""

    A: Array
    B: Array
    C: Array
    a: Array
    c: Array


def adjust(observed: Observations, camera: Camera, prior: Prior, start: Estimate) -> Adjusted:
    """The most probable positions, poses and calibration under a Cauchy loss, from `start`.

    The noise is judged from the residuals, and the adjustment repeated until it stands. A calibration that would leave
    its prior by more than four sigmas stands for an error that this model of the camera does not have: the file's is
    then kept, and its uncertainty only enters the covariance.
    """
    found = _settle(observed, camera, prior, start)
    if np.abs(found.estimate.calibration / _calibration_sigma(prior)).max() <= _BELIEVED:
        return found
    kept = replace(found.estimate, calibration=np.zeros(CALIBRATION))
    return _settle(observed, camera, prior, kept, calibrate=False)


def _settle(
    observed: Observations, camera: Camera, prior: Prior, start: Estimate, *, calibrate: bool = True
) -> Adjusted:
    free = prior if calibrate else replace(prior, sigma_focal=0.0, sigma_center_px=0.0, sigma_distortion=0.0)
    estimate, noise = start, np.full(len(prior.p_dock), 1.0)
    for _ in range(3):
        estimate = _minimise(observed, camera, free, estimate, noise)
        now = _noise_of(observed, camera, estimate)
        settled = np.abs(np.log(now / noise)).max() < 0.1
        noise = now
        if settled:
            break
    return _conclude(observed, camera, prior, estimate, noise, calibrate=calibrate)


def refine_poses(
    observed: Observations, camera: Camera, p_dock: Array, T_dock_cam: Array, sigma_px: Array
) -> tuple[Array, Array]:
    """Poses (F, 4, 4) that fit lights at known places best, and the robust cost (F,) of each; `sigma_px` (F, M)."""
    T, damping = T_dock_cam.copy(), np.full(len(T_dock_cam), 1e-3)
    cost = _frame_costs(observed, camera, Estimate(p_dock, T, np.zeros(CALIBRATION)), sigma_px)
    for _ in range(25):
        line = _linearised(observed, camera, Estimate(p_dock, T, np.zeros(CALIBRATION)))
        w = _weights(line.residual, sigma_px)
        A = np.einsum("fmki,fm,fmkj->fij", line.J_pose, w, line.J_pose)
        a = np.einsum("fmki,fm,fmk->fi", line.J_pose, w, np.nan_to_num(line.residual))
        A += damping[:, None, None] * (np.eye(6) * A + _OPEN * np.eye(6))
        step = (np.linalg.inv(A) @ a[..., None])[..., 0]
        tried = _moved(T, step)
        new = _frame_costs(observed, camera, Estimate(p_dock, tried, np.zeros(CALIBRATION)), sigma_px)
        better = new < cost
        gain = np.where(better, cost - new, 0.0)
        T[better], cost = tried[better], np.where(better, new, cost)
        damping = np.clip(np.where(better, damping / 5.0, damping * 5.0), 1e-9, 1e9)
        if (gain < 1e-2).all() and (better | (damping > 0.1)).all():
            break
    return T, cost


def _minimise(observed: Observations, camera: Camera, prior: Prior, start: Estimate, noise: Array) -> Estimate:
    sigma, now, damping = observed.sigma_px * noise, start, _FIRST_DAMPING
    cost = _cost(observed, camera, prior, now, sigma)
    for _ in range(_MOST_STEPS):
        normal = _normal(_linearised(observed, camera, now), prior, now, sigma)
        while damping < _MOST_DAMPING:
            tried = _stepped(now, normal, damping)
            new = _cost(observed, camera, prior, tried, sigma)
            if new < cost:
                break
            damping *= 10.0
        else:
            return now
        fall, now, cost, damping = cost - new, tried, new, max(damping / 10.0, 1e-9)
        if fall < _CONVERGED * (1.0 + cost):
            return now
    return now


def _linearised(observed: Observations, camera: Camera, at: Estimate) -> _Linear:
    R_dock_cam, t_dock_cam = at.T_dock_cam[:, :3, :3], at.T_dock_cam[:, :3, 3]
    p_cam = (at.p_dock[None] - t_dock_cam[:, None]) @ R_dock_cam
    f, m = p_cam.shape[:2]
    with np.errstate(all="ignore"):  # a light behind the camera is a NaN, which does not count
        uv, J_uv_p = camera.project_with_jacobian(p_cam.reshape(-1, 3))
    from_center = (uv - camera.center_px).reshape(f, m, 2)
    x = from_center / camera.focal_px
    r2 = (x * x).sum(axis=2)[..., None]
    focal, k1, k2 = at.calibration[[0, 3, 4]]
    scale = 1.0 + focal + k1 * r2 + k2 * r2 * r2
    expected = from_center * scale + camera.center_px + at.calibration[1:3]
    stretch = scale[..., None] * np.eye(2)
    stretch = (
        stretch
        + 2.0 * (k1 + 2.0 * k2 * r2)[..., None] * from_center[..., :, None] * (x / camera.focal_px)[..., None, :]
    )
    J = stretch @ J_uv_p.reshape(f, m, 2, 3)
    residual = observed.uv - expected
    good = np.isfinite(residual).all(axis=2)
    J = np.where(good[..., None, None], J, 0.0)
    J_calibration = np.zeros((f, m, 2, CALIBRATION))
    for column, factor in ((0, 1.0), (3, r2), (4, r2 * r2)):
        J_calibration[..., column] = np.where(good[..., None], from_center * factor, 0.0)
    J_calibration[..., 0, 1] = J_calibration[..., 1, 2] = good
    J_pose = np.concatenate([-J, J @ _skews(p_cam)], axis=3)
    return _Linear(
        np.where(good[..., None], residual, np.nan), J_pose, J @ R_dock_cam.swapaxes(1, 2)[:, None], J_calibration
    )


def _skews(p: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    out = np.zeros((*p.shape, 3))
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    return np.asarray(out - out.swapaxes(-1, -2))


def _weights(residual: Array, sigma: Array) -> Array:
    """Weights (F, M) 1/px^2 of the residuals (F, M, 2); 0 where there is none."""
    r2 = (residual**2).sum(axis=2) / sigma**2
    return np.asarray(np.nan_to_num(1.0 / (sigma**2 * (1.0 + r2 / _CAUCHY**2))))


def _frame_costs(observed: Observations, camera: Camera, at: Estimate, sigma: Array) -> Array:
    """Robust cost (F,) of the pixels; a detection whose light cannot be in view costs as much as a wild one."""
    r2 = (_linearised(observed, camera, at).residual ** 2).sum(axis=2) / sigma**2
    lost = observed.seen & ~np.isfinite(r2)
    return np.asarray(_CAUCHY**2 * np.log1p(np.where(lost, 1e6, np.nan_to_num(r2)) / _CAUCHY**2).sum(axis=1))


def _cost(observed: Observations, camera: Camera, prior: Prior, at: Estimate, sigma: Array) -> float:
    pixels = float(_frame_costs(observed, camera, at, sigma).sum())
    positions = float((((at.p_dock - prior.p_dock) / prior.sigma_m) ** 2).sum())
    tapes = sum(((_length(at.p_dock, tape) - tape.metres) / tape.sigma_m) ** 2 for tape in prior.distances)
    return pixels + positions + tapes + float(((at.calibration / _calibration_sigma(prior)) ** 2).sum())


def _calibration_sigma(prior: Prior) -> Array:
    center, bent = prior.sigma_center_px, prior.sigma_distortion
    return np.maximum([prior.sigma_focal, center, center, bent, bent], 1e-9)


def _length(p_dock: Array, tape: Distance) -> float:
    return float(np.linalg.norm(p_dock[tape.a] - p_dock[tape.b]))


def _normal(line: _Linear, prior: Prior, at: Estimate, sigma: Array, w: Array | None = None) -> _Normal:
    """Normal equations; with weights `w` (F, M) in place of the robust ones."""
    w = _weights(line.residual, sigma) if w is None else w
    f, m = w.shape
    r = np.nan_to_num(line.residual)
    A = np.einsum("fmki,fm,fmkj->fij", line.J_pose, w, line.J_pose)
    B_light = np.einsum("fmki,fm,fmkj->fimj", line.J_pose, w, line.J_light).reshape(f, 6, 3 * m)
    B_calibration = np.einsum("fmki,fm,fmkj->fij", line.J_pose, w, line.J_calibration)
    C = np.zeros((3 * m + CALIBRATION, 3 * m + CALIBRATION))
    of_light = np.einsum("fmki,fm,fmkj->mij", line.J_light, w, line.J_light)
    for i in range(m):
        C[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = of_light[i]
    cross = np.einsum("fmki,fm,fmkj->mij", line.J_light, w, line.J_calibration).reshape(3 * m, CALIBRATION)
    C[: 3 * m, 3 * m :], C[3 * m :, : 3 * m] = cross, cross.T
    C[3 * m :, 3 * m :] = np.einsum("fmki,fm,fmkj->ij", line.J_calibration, w, line.J_calibration)
    a = np.einsum("fmki,fm,fmk->fi", line.J_pose, w, r)
    c_light = np.einsum("fmki,fm,fmk->mi", line.J_light, w, r).ravel()
    c = np.concatenate([c_light, np.einsum("fmki,fm,fmk->i", line.J_calibration, w, r)])
    information, pull = _of_prior(prior, at)
    return _Normal(A, np.concatenate([B_light, B_calibration], axis=2), C + information, a, c + pull)


def _of_prior(prior: Prior, at: Estimate) -> tuple[Array, Array]:
    """Information (S, S) and gradient (S,) of what is known before."""
    n = prior.p_dock.size
    information, pull = np.zeros((n + CALIBRATION, n + CALIBRATION)), np.zeros(n + CALIBRATION)
    w = np.concatenate([(1.0 / prior.sigma_m**2).ravel(), 1.0 / _calibration_sigma(prior) ** 2])
    information[np.diag_indices_from(information)] = w
    pull += w * np.concatenate([(prior.p_dock - at.p_dock).ravel(), -at.calibration])
    for tape in prior.distances:
        apart = at.p_dock[tape.a] - at.p_dock[tape.b]
        J = np.zeros(n + CALIBRATION)
        J[3 * tape.a : 3 * tape.a + 3] = apart / np.linalg.norm(apart)
        J[3 * tape.b : 3 * tape.b + 3] = -J[3 * tape.a : 3 * tape.a + 3]
        information += np.outer(J, J) / tape.sigma_m**2
        pull += J * (tape.metres - _length(at.p_dock, tape)) / tape.sigma_m**2
    return information, pull


def _stepped(at: Estimate, normal: _Normal, damping: float) -> Estimate:
    """One damped Gauss-Newton step: first what the frames share, then each pose."""
    A = normal.A + damping * np.eye(6) * normal.A + _OPEN * np.eye(6)
    AB = np.linalg.inv(A) @ np.concatenate([normal.B, normal.a[..., None]], axis=2)
    f, _, s = normal.B.shape
    flat_B, flat_AB = normal.B.reshape(6 * f, s), AB.reshape(6 * f, s + 1)
    reduced = flat_B.T @ flat_AB
    S = normal.C - reduced[:, :s]
    S[np.diag_indices(s)] += damping * np.diagonal(normal.C)
    shared = np.linalg.solve(S, normal.c - reduced[:, s])
    poses = AB[..., s] - AB[..., :s] @ shared
    m3 = at.p_dock.size
    return Estimate(at.p_dock + shared[:m3].reshape(-1, 3), _moved(at.T_dock_cam, poses), at.calibration + shared[m3:])


def _moved(T_dock_cam: Array, xi: Array) -> Array:
    """Poses (F, 4, 4) moved by (F, 6) [m along the camera's axes, rad]; the rotation by Rodrigues' formula."""
    out, w = T_dock_cam.copy(), xi[:, 3:]
    angle = np.sqrt((w**2).sum(axis=1))[:, None, None]
    K = _skews(w)
    turn = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (K @ K)
    out[:, :3, 3] += (T_dock_cam[:, :3, :3] @ xi[:, :3, None])[..., 0]
    out[:, :3, :3] = T_dock_cam[:, :3, :3] @ turn
    return out


def _noise_of(observed: Observations, camera: Camera, at: Estimate) -> Array:
    """How much the centres of each light (M,) scatter, in units of `sigma_px`, from the median of their residuals."""
    r2 = (_linearised(observed, camera, at).residual ** 2).sum(axis=2) / observed.sigma_px**2
    equations, unknowns = 2 * np.isfinite(r2).sum(), 6 * len(r2) + at.p_dock.size
    share = np.sqrt(max(1.0 - unknowns / max(equations, 1), 0.1))  # the residuals that the unknowns leave
    everyone = np.sqrt(np.nanmedian(r2) / _MEDIAN_CHI2) / share
    noise = np.full(r2.shape[1], everyone)
    for light in np.flatnonzero(np.isfinite(r2).sum(axis=0) >= _ENOUGH):
        noise[light] = np.sqrt(np.nanmedian(r2[:, light]) / _MEDIAN_CHI2) / share
    return np.asarray(np.maximum(noise, np.maximum(_LEAST_NOISE, 0.3 * everyone)))


def _conclude(
    observed: Observations, camera: Camera, prior: Prior, at: Estimate, noise: Array, *, calibrate: bool
) -> Adjusted:
    """Covariance by the detections that agree, each worth `repeats` times less than if errors were independent."""
    line = _linearised(observed, camera, at)
    sigma = observed.sigma_px * noise
    r2 = (line.residual**2).sum(axis=2) / sigma**2
    used = np.isfinite(r2) & (r2 < _OUTLIER**2)
    used &= (used.sum(axis=1) >= LEAST_LIGHTS)[:, None]
    spread = max(float(r2[used].mean()) / _expected_chi2(used), 1.0) if used.any() else 1.0
    repeats = _repeats(observed, line.residual / sigma[..., None], used) * spread
    normal = _normal(line, prior, at, sigma, used / (sigma**2 * repeats))
    f, _, s = normal.B.shape
    AB = np.linalg.inv(normal.A + _OPEN * np.eye(6)) @ normal.B
    S = normal.C - normal.B.reshape(6 * f, s).T @ AB.reshape(6 * f, s)
    S = 0.5 * (S + S.T)
    covariance = np.linalg.inv(S) if calibrate else _considered(S, _calibration_sigma(prior))
    return Adjusted(at, covariance, line.residual, noise, used, repeats=repeats, calibrated=calibrate)


def _considered(S: Array, calibration_sigma: Array) -> Array:
    """Covariance where the calibration was kept as it was, with its error carried into the positions.

    Source: S. F. Schmidt, 1966 (consider parameters).
    """
    n = len(S) - CALIBRATION
    positions = np.linalg.inv(S[:n, :n])
    carried = -positions @ S[:n, n:]
    C = np.diag(calibration_sigma**2)
    top = np.concatenate([positions + carried @ C @ carried.T, carried @ C], axis=1)
    return np.concatenate([top, np.concatenate([C @ carried.T, C], axis=1)])


def _expected_chi2(used: np.ndarray) -> float:
    """Mean square in sigmas of the residuals that the unknowns leave."""
    equations, unknowns = 2 * int(used.sum()), 6 * len(used) + 3 * used.shape[1]
    return float(2.0 * max(1.0 - unknowns / max(equations, 1), 0.1))


def _repeats(observed: Observations, residual: Array, used: np.ndarray) -> float:
    """(1 + rho) / (1 - rho) with rho the correlation of a light's residuals in successive frames.

    Source: M. S. Bartlett, 1946: by so much fewer independent values has a first-order autoregressive series.
    """
    after = (np.diff(observed.recording) == 0)[:, None] & used[1:] & used[:-1]
    both = (residual[1:] * residual[:-1]).sum(axis=2)[after].sum()
    each = 0.5 * ((residual[1:] ** 2).sum(axis=2) + (residual[:-1] ** 2).sum(axis=2))[after].sum()
    rho = float(np.clip(both / each, 0.0, 0.95)) if after.any() else 0.0
    return (1.0 + rho) / (1.0 - rho)


def reprojection(observed: Observations, camera: Camera, p_dock: Array, T_dock_cam: Array) -> Array:
    """Residuals (F, M, 2) px of lights at `p_dock` (M, 3) from poses (F, 4, 4), the camera taken as calibrated."""
    return _linearised(observed, camera, Estimate(p_dock, T_dock_cam, np.zeros(CALIBRATION))).residual


def with_distances(prior: Prior, distances: tuple[Distance, ...]) -> Prior:
    """The same prior with these distances."""
    return replace(prior, distances=distances)


def thinned(frames: Indices, most: int) -> Indices:
    """At most `most` of the frames, evenly spread."""
    if len(frames) <= most:
        return frames
    return frames[np.linspace(0, len(frames) - 1, most).round().astype(np.int64)]


def tilt_sigma(observed: Observations, camera: Camera, at: Estimate) -> Array:
    """The 1-sigma error (F,) rad of each frame's tilt about the camera's x and y axes, the lights taken as known."""
    line = _linearised(observed, camera, at)
    w = np.where(observed.seen, 1.0 / observed.sigma_px**2, 0.0)
    A = np.einsum("fmki,fm,fmkj->fij", line.J_pose, w, line.J_pose)
    covariance = np.linalg.inv(A + _OPEN * np.eye(6))
    return np.asarray(np.sqrt(np.maximum(covariance[:, 3, 3], covariance[:, 4, 4])))


def information(observed: Observations, camera: Camera, at: Estimate) -> Array:
    """What frames say of positions and calibration (S, S), their poses eliminated and nothing known before."""
    line = _linearised(observed, camera, at)
    m = len(at.p_dock)
    nothing = Prior(at.p_dock, np.full((m, 3), np.inf), np.inf, np.inf, np.inf)
    normal = _normal(line, nothing, at, observed.sigma_px, np.where(observed.seen, 1.0 / observed.sigma_px**2, 0.0))
    f, _, s = normal.B.shape
    AB = np.linalg.inv(normal.A + _OPEN * np.eye(6)) @ normal.B
    return np.asarray(normal.C - normal.B.reshape(6 * f, s).T @ AB.reshape(6 * f, s))
