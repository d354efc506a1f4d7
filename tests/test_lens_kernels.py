import math

import numpy as np
import pytest
from conftest import assert_close, called, numeric_jacobian
from scipy.spatial.transform import Rotation

from lumidock._kernels import lens, pose
from lumidock._kernels.pose import flipped
from lumidock.camera import Camera
from lumidock.geometry import se3_exp, so3_exp

factor, inside, invert6, project = map(called, (lens.factor, lens.inside, lens.invert6, lens.project))
rotate_exp, solve_factored = called(lens.rotate_exp), called(lens.solve_factored)
attitude_error, light_row = called(pose.attitude_error), called(pose.light_row)
normal_equations, refine = called(pose.normal_equations), called(pose.refine)
K = np.array([[1400.0, 0.0, 1000.0], [0.0, 1300.0, 800.0], [0.0, 0.0, 1.0]])
HEAD_ON = np.diag([1.0, -1.0, -1.0])
PLANE = np.array([[-1, 0.6, 0], [1, 0.5, 0], [0.9, -0.6, 0], [-0.8, -0.5, 0], [0.1, 0.9, 0]])


@pytest.fixture(
    params=[
        ("plumb_bob", [0.0, 0.0, 0.0, 0.0, 0.0]),
        ("plumb_bob", [-0.28, 0.12, 0.001, -0.002, -0.02]),
        ("rational_polynomial", [0.8, -0.1, 0.001, -0.001, 0.01, 1.1, 0.1, 0.02]),
        ("equidistant", [0.05, -0.04, 0.01, -0.002]),
    ],
    ids=["pinhole", "plumb_bob", "rational", "equidistant"],
)
def camera(request):
    model, distortion = request.param
    return Camera(2000, 1600, K, model, np.array(distortion))


def positive(rng, n):
    """A symmetric positive definite matrix (n, n) whose scales differ as metres and radians do."""
    A = rng.normal(size=(n, 2 * n)) * 10.0 ** rng.uniform(-2, 2, (n, 1))
    return A @ A.T


def view(rng, z=8.0):
    """Rotation and translation of T_cam_dock, up to 20 degrees off head-on."""
    R = so3_exp(rng.uniform(-0.2, 0.2, 3)) @ HEAD_ON
    return np.ascontiguousarray(R), np.array([*rng.uniform(-0.5, 0.5, 2), z])


def test_project_is_the_camera_point_by_point(camera, rng):
    p_cam = rng.normal(size=(400, 3)) * [3.0, 3.0, 5.0]  # before, beside and behind the lens
    p_cam[:4] = [[0, 0, 2], [0, 0, -2], [0, 0, 0], [1e-12, 0, 1]]
    uv, J = camera.project_with_jacobian(p_cam)
    seen = 0
    for k, (x, y, z) in enumerate(p_cam):
        visible, u, v, ux, uy, uz, vx, vy, vz = project(camera.lens(), x, y, z)
        assert visible == np.isfinite(uv[k]).all()
        if visible:
            seen += 1
            assert_close([u, v], uv[k], rtol=1e-11, atol=1e-9)
            assert_close([[ux, uy, uz], [vx, vy, vz]], J[k], rtol=1e-9, atol=1e-6)
    assert 50 < seen < 400


def test_inside_is_the_cameras_picture(camera, rng):
    uv = rng.uniform([-30, -30], [2030, 1630], (500, 2))
    uv[:4] = [[-0.5, 5], [1999.5, 5], [5, -0.5], [5, 1599.5]]
    for margin in (0.0, 3.0, -10.0):
        expected = camera.contains(uv, margin_px=margin)
        assert [inside(camera.lens(), u, v, margin) for u, v in uv] == expected.tolist()
        assert 0 < expected.sum() < 500


def test_factor_and_its_solver_agree_with_numpy(rng):
    for n in (1, 2, 6, 9, 26):
        A, b = positive(rng, n), rng.normal(size=n)
        L = np.full((n + 2, n + 2), np.nan)  # only the leading lower triangle may be read
        L[:n, :n] = np.where(np.tri(n, dtype=bool), A, np.nan)
        log_det, x = factor(L, n), b.copy()
        solve_factored(L, n, x)
        assert_close(log_det, np.linalg.slogdet(A)[1], rtol=1e-10)
        assert_close(np.tril(L[:n, :n]), np.linalg.cholesky(A), rtol=1e-7, atol=1e-9 * np.abs(A).max())
        assert_close(A @ x, b, atol=1e-6)


def test_invert6_agrees_with_numpy(rng):
    for _ in range(50):
        A, L, P = positive(rng, 6), np.full((6, 6), np.nan), np.full((6, 6), np.nan)
        assert_close(invert6(A, L, P), np.linalg.slogdet(A)[1], rtol=1e-10)
        assert_close(P @ A, np.eye(6), atol=1e-5)
        assert (P == P.T).all()


@pytest.mark.parametrize("worst", [0.0, -1.0, np.nan])
def test_what_is_not_positive_has_no_factor(worst, rng):
    A = positive(rng, 6)
    A[4, :] = A[:, 4] = 0.0
    A[4, 4] = worst
    assert math.isnan(invert6(A, np.empty((6, 6)), np.empty((6, 6))))
    assert math.isnan(factor(A.copy(), 6))
    assert math.isfinite(factor(A.copy(), 4))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 0.3, 2.0, np.pi, 6.0])
def test_rotate_exp_is_so3_exp_on_the_right(angle, rng):
    R = Rotation.random(rng=rng).as_matrix()
    axis = rng.normal(size=3)
    w = angle * axis / np.linalg.norm(axis)
    turned = R.copy()
    rotate_exp(turned, *w)
    # (1 - cos a) / a^2 loses what a small angle cannot show
    assert_close(turned, R @ so3_exp(w), atol=1e-13)
    assert_close(turned @ turned.T, np.eye(3), atol=1e-13)


def test_light_row_is_the_pixel_and_its_derivatives(camera, rng):
    for _ in range(20):
        R, t = view(rng, rng.uniform(2, 20))
        p = rng.uniform(-1, 1, 3)
        T_cam_dock = np.eye(4)
        T_cam_dock[:3, :3], T_cam_dock[:3, 3] = R, t

        def pixel(xi, T_cam_dock=T_cam_dock, p=p):
            T = T_cam_dock @ se3_exp(xi)
            return camera.project((T[:3, :3] @ p + T[:3, 3])[None])[0]

        def shifted(d, R=R, t=t, p=p):
            return camera.project((R @ (p + d) + t)[None])[0]

        h = np.empty(14)
        assert light_row(camera.lens(), R, t, p, h)
        rows = h[2:].reshape(2, 6)
        assert_close(h[:2], pixel(np.zeros(6)), atol=1e-9)
        assert_close(rows, numeric_jacobian(pixel, np.zeros(6)), rtol=1e-6, atol=1e-4)
        assert_close(rows[:, :3], numeric_jacobian(shifted, np.zeros(3)), rtol=1e-6, atol=1e-4)


def test_a_light_behind_the_camera_has_no_row(camera):
    assert not light_row(camera.lens(), np.eye(3), np.array([0.0, 0.0, -1.0]), np.zeros(3), np.empty(14))


def test_attitude_error_is_tilt_and_roll_with_its_derivative(rng):
    def error(R, Rp):
        e, J = np.empty(3), np.empty((3, 3))
        attitude_error(R, Rp, e, J)
        return e, J

    for _ in range(50):
        Rp = np.ascontiguousarray(Rotation.random(rng=rng).as_matrix())
        R = np.ascontiguousarray(so3_exp(rng.uniform(-0.9, 0.9, 3)) @ Rp.T)
        expected = numeric_jacobian(lambda w, R=R, Rp=Rp: error(R @ so3_exp(w), Rp)[0], np.zeros(3))
        assert_close(error(R, Rp)[1], expected, atol=1e-7)
        # a pure roll is a roll and no tilt; a pure tilt is no roll and as large as its stereographic length
        angle, direction = rng.uniform(-3, 3), rng.uniform(0, 2 * np.pi)
        assert_close(np.abs(error(so3_exp(np.array([0, 0, angle])) @ Rp.T, Rp)[0]), [0, 0, abs(angle)], atol=1e-9)
        axis = np.array([np.cos(direction), np.sin(direction), 0.0])
        e, _ = error(so3_exp(angle * axis) @ Rp.T, Rp)
        assert_close([np.hypot(e[0], e[1]), e[2]], [2 * np.tan(abs(angle) / 2), 0.0], rtol=1e-9, atol=1e-9)


def test_normal_equations_are_half_the_costs_curvature_and_slope(camera, rng):
    R, t = view(rng)
    p, n = PLANE, len(PLANE)
    uv = camera.project(p @ R.T + t) + rng.normal(0, 0.5, (n, 2))
    var, info = rng.uniform(0.2, 2.0, n), np.array([10.0, 20.0, 30.0])

    def at(xi, H, g):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t
        T = T @ se3_exp(xi)
        turned, moved = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        return normal_equations(camera.lens(), p, uv, var, turned, moved, HEAD_ON, info, H, g)

    H, g, spare, none = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.empty(6)
    cost = at(np.zeros(6), H, g)
    off = (camera.project(p @ R.T + t) - uv) / np.sqrt(var)[:, None]
    e = np.empty(3)
    attitude_error(R, HEAD_ON, e, np.empty((3, 3)))
    assert_close(cost, (off**2).sum() + (info * e**2).sum(), rtol=1e-10)
    slope = numeric_jacobian(lambda xi: np.array(at(xi, spare, none)), np.zeros(6))
    assert_close(g, -0.5 * slope, rtol=1e-5, atol=1e-2)
    assert (np.linalg.eigvalsh(np.tril(H) + np.tril(H, -1).T) > 0).all()


def test_refine_arrives_where_the_slope_is_zero(camera, rng):
    for _ in range(20):
        R, t = view(rng)
        uv = camera.project(PLANE @ R.T + t) + rng.normal(0, 0.3, (len(PLANE), 2))
        info = np.full(3, np.deg2rad(5.0) ** -2)
        start = np.ascontiguousarray(R @ so3_exp(rng.uniform(-0.1, 0.1, 3))), t + rng.uniform(-0.3, 0.3, 3)
        Rn, tn, H, L = *start, np.empty((6, 6)), np.empty((6, 6))
        args = (camera.lens(), PLANE, uv, np.full(len(uv), 0.09))
        cost, log_det = refine(*args, Rn, tn, HEAD_ON, info, 40, H, L)
        full = np.tril(H) + np.tril(H, -1).T
        g = np.empty(6)
        again = normal_equations(*args, Rn, tn, HEAD_ON, info, np.empty((6, 6)), g)
        assert_close(log_det, np.linalg.slogdet(full)[1], rtol=1e-9)
        assert_close(again, cost, rtol=1e-9)
        assert g @ np.linalg.solve(full, g) < 1e-3  # what one more step would gain
        assert_close(Rn @ Rn.T, np.eye(3), atol=1e-12)


def test_flip_is_its_own_inverse_and_keeps_the_centre(rng):
    for _ in range(20):
        R, t = view(rng, 15.0)
        R2, t2 = R.copy(), t.copy()
        assert flipped(PLANE, R2, t2) < 1e-3
        centre = PLANE.mean(axis=0)
        assert_close(R2 @ centre + t2, R @ centre + t, atol=1e-9)
        assert_close(R2 @ R2.T, np.eye(3), atol=1e-9)
        assert_close(np.linalg.det(R2), 1.0, atol=1e-9)
        flat = [PLANE @ A.T + b for A, b in ((R, t), (R2, t2))]
        apart = np.abs(flat[0][:, :2] / flat[0][:, 2:] - flat[1][:, :2] / flat[1][:, 2:]).max()
        assert apart < 0.25 * np.abs(PLANE).max() / 15.0  # small against the array's own size: perspective alone
        flipped(PLANE, R2, t2)
        assert_close(R2, R, atol=1e-6)
        assert_close(t2, t, atol=1e-6)
