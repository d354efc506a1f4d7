"""The simulator's physics against independent oracles: photons, rays, OpenCV, counting statistics."""

import cv2
import numba
import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station
from scipy.integrate import trapezoid

from lumidock.camera import Camera
from lumidock.geometry import se3_inverse, so3_log
from lumidock.sim import knobs, optics, sensor, surroundings, water
from lumidock.sim.canvas import Canvas, Mosaic, core_profile
from lumidock.sim.lens import Lens, calibrated_in_water
from lumidock.sim.scattering import backscatter_share, halo, phase_at, phase_function
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, load_scenario, trajectory

STATION, CAMERA = shipped_station(), shipped_camera()
BARE = knobs.LensKnobs(glare=0.0, ghost=0.0, falloff=0.0)
SCENARIO = load_scenario("approach")
MONO = knobs.Output(color=False, pixels="mono8")
EXPOSURE_S = 2e-3


def head_on(z):
    T = np.eye(4)
    T[:3, :3] = R_DOCK_CAM_HEAD_ON
    T[2, 3] = z
    return T


def lens_of(lens_knobs=BARE, camera=CAMERA):
    return Lens.of(lens_knobs, camera, water.green_index(knobs.WaterKnobs()))


def lamp(p_cam, watt_sr=(0.2, 0.3, 0.2), radius_m=0.0175, lens=None):
    view = optics.Exposure(lens or lens_of(), np.eye(4), EXPOSURE_S)
    return optics.emitters("lamp", view, np.array([p_cam]), np.array([watt_sr]), radius_m)


def drawn(seen, absorption, scattering, phase="harbour", output=MONO, lens=None):
    canvas = Canvas(lens or lens_of(), Mosaic.of(output), np.array(absorption), np.array(scattering), phase)
    canvas.add(seen, np.zeros((len(seen), 2)))
    return canvas.expected()


# Scattering


@numba.njit
def fly(photons, a, b, radius, cdf, angle, edges, rng):
    """Light leaving a sphere around an isotropic lamp: unscattered, and by angle to the radius, per flat area."""
    rings, direct = np.zeros(len(edges) - 1), 0.0
    for _ in range(photons):
        x, y, z, dx, dy, dz, weight, scattered = 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, False
        while weight > 1e-4 and x * x + y * y + z * z < 4.0 * radius * radius:
            step = -np.log(rng.random()) / b
            along = x * dx + y * dy + z * dz
            root = along * along - (x * x + y * y + z * z) + radius * radius
            out = np.sqrt(root) - along if root > 0.0 else -1.0
            if 1e-9 < out <= step:
                cosine = min((along + out) / radius, 1.0)
                light = weight * np.exp(-a * out)
                if not scattered:
                    direct += light
                elif cosine > 0.0:
                    ring = np.searchsorted(edges, np.arccos(cosine)) - 1
                    if ring < len(rings):
                        rings[max(ring, 0)] += light / cosine
            x, y, z = x + step * dx, y + step * dy, z + step * dz
            weight, scattered = weight * np.exp(-a * step), True
            bend, turn = np.interp(rng.random(), cdf, angle), 2.0 * np.pi * rng.random()
            # two unit vectors across the way, by Gram-Schmidt from the axis that is farther from it
            ex, ey = (1.0, 0.0) if abs(dx) < 0.7 else (0.0, 1.0)
            dot = ex * dx + ey * dy
            sx, sy, sz = ex - dot * dx, ey - dot * dy, -dot * dz
            norm = np.sqrt(sx * sx + sy * sy + sz * sz)
            sx, sy, sz = sx / norm, sy / norm, sz / norm
            tx, ty, tz = dy * sz - dz * sy, dz * sx - dx * sz, dx * sy - dy * sx
            c, s, cc, ss = np.cos(turn), np.sin(turn), np.cos(bend), np.sin(bend)
            dx, dy, dz = (
                cc * dx + ss * (c * sx + s * tx),
                cc * dy + ss * (c * sy + s * ty),
                cc * dz + ss * (c * sz + s * tz),
            )
    return direct / photons, rings / photons


def flown(a, b, distance_m, kind, edges_rad, photons=400_000, seed=1):
    angle, beta = phase_function(kind)
    density = 2.0 * np.pi * beta * np.sin(angle)
    cdf = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(angle))])
    rng = np.random.default_rng(seed)
    return fly(photons, a, b, distance_m, cdf=cdf / cdf[-1], angle=angle, edges=edges_rad, rng=rng)


EDGES_DEG = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0])


@pytest.mark.parametrize(
    ("kind", "a", "b", "distance_m"),
    [
        ("harbour", 0.08, 0.29, 3.0),
        ("harbour", 0.08, 0.29, 20.0),
        ("coastal", 0.09, 0.43, 10.0),
        ("clear", 0.05, 0.12, 15.0),
    ],
)
def test_rings_of_a_rendered_halo_have_the_light_that_a_photon_run_gives_them(kind, a, b, distance_m):
    edges = np.deg2rad(EDGES_DEG)
    direct, rings = flown(a, b, distance_m, kind, edges)
    assert direct == pytest.approx(np.exp(-(a + b) * distance_m), rel=0.1)
    at = np.array([0.0, 0.0, distance_m])
    seen = lamp(at, (0.0, 1e4, 0.0), radius_m=1e-4)
    picture = drawn(seen, (1.0, a, 1.0), (0.0, b, 0.0), kind)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = lens_of().rays(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    angle = np.arccos(np.clip(ray[:, 2], -1.0, 1.0)).reshape(u.shape)
    whole = seen.at_lens[0, 1] * 0.65  # quantum efficiency without colour
    # each pixel's share of the irradiance that there would be without water, freed of the cosine of the aperture
    light = picture / whole / np.cos(angle)
    for i in range(2, len(rings)):  # the innermost hold the lamp itself
        inside = (angle >= edges[i]) & (angle < edges[i + 1])
        edge_share = light[inside].sum() / inside.sum() * (2 * np.pi * (np.cos(edges[i]) - np.cos(edges[i + 1])))
        area = (np.cos(angle[inside]) ** 3).mean() / CAMERA.K[0, 0] ** 2
        assert edge_share / area == pytest.approx(rings[i], rel=0.15), EDGES_DEG[i]


def test_a_photon_run_with_another_phase_function_does_not_fit():
    edges = np.deg2rad(EDGES_DEG)
    rings = flown(0.08, 0.29, 10.0, "harbour", edges, photons=100_000)[1]
    theta, values = halo(0.08, 0.29, "coastal", 10.0)
    fine = np.exp(np.linspace(np.log(edges[3]), np.log(edges[4]), 50))
    ring = trapezoid(2 * np.pi * np.sin(fine) * np.interp(fine, theta, values), fine)
    assert abs(ring / rings[3] - 1.0) > 0.15


@pytest.mark.parametrize(("kind", "share"), [("clear", 0.044), ("coastal", 0.013), ("harbour", 0.019)])
def test_phase_functions_have_petzolds_backscatter_and_are_normalised(kind, share):
    """The shares stand in his report beside the tables."""
    assert backscatter_share(kind) == pytest.approx(share, rel=0.05)
    angle = np.linspace(1e-4, np.pi, 400_000)
    beyond = 1.0 - trapezoid(2 * np.pi * phase_at(kind, angle) * np.sin(angle), angle)
    assert 0.0 <= beyond < 0.15  # what scatters by less than a hundredth of a degree


def test_halos_grow_with_scattering_and_range():
    def width(b, distance_m):
        theta, values = halo(0.08, b, "harbour", distance_m)
        light = np.cumsum(values * theta**2)
        return theta[np.searchsorted(light, 0.5 * light[-1])]

    assert width(0.1, 5.0) < width(0.3, 5.0) < width(0.3, 20.0) < width(1.0, 20.0)


# Water


def test_index_is_the_known_one():
    """n of sea water at 35 psu, 20 C and 589.3 nm is 1.3394, of pure water 1.3330 (tables of Austin & Halikas 1976)."""
    at = np.interp(589.3, water.BAND_NM, water.index(knobs.WaterKnobs(salinity_psu=35.0, temperature_c=20.0)))
    pure = np.interp(589.3, water.BAND_NM, water.index(knobs.WaterKnobs(salinity_psu=0.0, temperature_c=20.0)))
    assert at == pytest.approx(1.3394, abs=4e-4)
    assert pure == pytest.approx(1.3330, abs=4e-4)


def test_salt_and_warmth_change_absorption_in_the_red():
    cold, warm = (water.absorption_scattering(knobs.WaterKnobs(temperature_c=t))[0] for t in (5.0, 25.0))
    assert warm[2] - cold[2] == pytest.approx(0.0184, rel=0.01)
    assert warm[0] == cold[0]


# Radiometry


@pytest.mark.parametrize("distance_m", [4.0, 10.0, 22.0])
def test_flux_of_a_lamp_is_inverse_square_times_attenuation(distance_m):
    """Absolute, from the rendered electrons: I / r^2, pupil, exposure, photon energy, quantum efficiency."""
    picture = drawn(lamp((0.0, 0.0, distance_m)), (0.107, 0.0806, 0.287), (0.0, 0.0, 0.0))
    joule = 6.62607015e-34 * 299792458.0 / (np.array([455.0, 530.0, 610.0]) * 1e-9)
    pupil_m2 = np.pi / 4 * (7.2e-3 / 2.8) ** 2
    irradiance = np.array([0.2, 0.3, 0.2]) / distance_m**2 * np.exp(-np.array([0.107, 0.0806, 0.287]) * distance_m)
    wanted = (irradiance * pupil_m2 * EXPOSURE_S / joule * [0.60, 0.65, 0.55]).sum()
    assert picture.sum(dtype=float) == pytest.approx(wanted, rel=0.03)


def test_scattering_takes_from_the_direct_light_what_beer_says():
    canvas = Canvas(lens_of(), Mosaic.of(MONO), np.full(3, 0.1), np.full(3, 0.3), "harbour")
    no_halo = optics.Emitters(
        *(getattr(lamp((0.5, 0.2, 12.0)), name) for name in optics.Emitters.__slots__[:-2]), [0.0], [True]
    )
    canvas.add(no_halo, np.zeros((1, 2)))
    lost = canvas.expected().sum(dtype=float) / (no_halo.at_lens[0] @ [0.60, 0.65, 0.55])
    assert lost == pytest.approx(np.exp(-0.4 * no_halo.range_m[0]), rel=0.03)


def test_beam_falls_to_half_at_its_half_angle():
    def green(angle):
        T = np.eye(4)
        T[:3, :3] = R_DOCK_CAM_HEAD_ON @ np.array(cv2.Rodrigues(np.array([0.0, -angle, 0.0]))[0])
        T[:3, 3] = STATION.p_dock[0] + 5.0 * np.array([np.sin(angle), 0, np.cos(angle)])
        watts = optics.lamp_watts(SCENARIO, STATION, np.ones(len(STATION)), 1.0)
        seen = optics.lamps(optics.Exposure(lens_of(), T, EXPOSURE_S), STATION, STATION.p_dock, watts, knobs.Lamps())
        assert seen.lit[0]
        return seen.at_lens[0, 1]

    assert green(np.deg2rad(60.0)) / green(0.0) == pytest.approx(0.5, rel=1e-3)
    assert green(np.deg2rad(45.0)) / green(0.0) == pytest.approx(np.cos(np.deg2rad(45.0)), rel=1e-3)


def test_beams_of_all_widths_send_out_their_power():
    angle = np.linspace(0.0, np.pi / 2, 20_001)
    for beam_deg in (30.0, 90.0, 120.0, 170.0):
        watt_sr = optics.intensity(np.array(3.0), beam_deg, np.cos(angle))
        assert trapezoid(2 * np.pi * watt_sr * np.sin(angle), angle) == pytest.approx(3.0, rel=1e-3)


@pytest.mark.parametrize(("start_s", "share"), [(0.0, 1.0), (1e-3, 0.25), (4e-3, 0.0), (19e-3, 0.5)])
def test_pulses_are_on_for_their_part_of_the_exposure(start_s, share):
    """50 Hz, on for 1.5 ms of each 20 ms; exposures of 2 ms."""
    wanted = {1.0: 0.75}.get(share, share)
    assert optics.on_share(50.0, 0.075, start_s, 2e-3) == pytest.approx(wanted)
    assert optics.on_share(50.0, 0.075, start_s, 2.0) == pytest.approx(0.075, abs=1e-3)


# Geometry


@pytest.mark.parametrize("distortion", [np.zeros(5), np.array([-0.2, 0.05, 0.001, -0.002, 0.01])])
def test_projection_agrees_with_opencv(distortion):
    camera = Camera(CAMERA.width, CAMERA.height, CAMERA.K, "plumb_bob", distortion)
    T = trajectory(SCENARIO, np.random.default_rng(3))[1][140]
    T_cam_dock = se3_inverse(T)
    uv, _ = cv2.projectPoints(STATION.p_dock, so3_log(T_cam_dock[:3, :3]), T_cam_dock[:3, 3], CAMERA.K, distortion)
    watts = np.ones((len(STATION), 3))
    view = optics.Exposure(lens_of(camera=camera), T, EXPOSURE_S)
    seen = optics.lamps(view, STATION, STATION.p_dock, watts, knobs.Lamps())
    np.testing.assert_allclose(seen.uv, uv[:, 0], atol=1e-6)


def refracted(direction, n_from, n_to):
    """A unit direction behind a surface across z. Source: Snell's law as vectors (Heckbert)."""
    ratio, cosine = n_from / n_to, direction[2]
    along = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
    return ratio * direction + (along - ratio * cosine) * np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("distance_m", [0.5, 2.0, 20.0])
def test_the_port_bends_light_as_a_traced_ray(distance_m, rng):
    port = knobs.Port(gap_m=0.03, glass_m=0.012, glass_index=1.49)
    lens = lens_of(knobs.LensKnobs(port=port))
    assert lens.index == pytest.approx(1.342, abs=0.002)
    for uv in rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (30, 2)):
        air = np.append((uv - lens.camera.center_px) / lens.camera.focal_px, 1.0)
        air /= np.linalg.norm(air)
        glass = refracted(air, 1.0, 1.49)
        wet = refracted(glass, 1.49, lens.index)
        p = air * (0.03 / air[2]) + glass * (0.012 / glass[2])
        p = p + wet * ((distance_m - p[2]) / wet[2])
        np.testing.assert_allclose(lens.project(p[None] - [0.0, 0.0, lens.viewpoint_m])[0], uv, atol=1e-6)
        np.testing.assert_allclose(lens.rays(uv[None])[0], wet, atol=1e-9)


def test_a_calibration_in_water_holds_where_it_was_made_and_no_nearer():
    lens = lens_of(knobs.LensKnobs(port=knobs.Port(gap_m=0.03)))
    camera = calibrated_in_water(lens, CAMERA)
    uv = np.array([[1223.5, 1023.5], [1900.0, 1500.0], [200.0, 300.0], [2300.0, 1900.0]])
    rays = camera.unproject(uv)

    def off_px(distance_m, held):
        p_cam = rays * (distance_m / rays[:, 2:])
        return np.linalg.norm(held.project(p_cam) - lens.project(p_cam), axis=1).max()

    assert max(off_px(z, camera) for z in (1.5, 3.0, 6.0, 20.0)) < 1.5
    assert off_px(0.3, camera) > 5.0
    assert off_px(3.0, CAMERA) > 30.0  # as if there were no port


def test_a_calm_surface_shows_each_lamp_where_a_mirror_would(rng):
    T = head_on(8.0)
    surface = knobs.WaterSurface(height_m=1.7, slope=0.0, fragments=2)
    watts = np.ones((len(STATION), 3))
    view = optics.Exposure(lens_of(), T, EXPOSURE_S, t_s=0.3)
    cores, halos = surroundings.mirrored(
        surface, 1.34, view, surroundings.LampSet(STATION, STATION.p_dock, watts, 0.0175), rng
    )
    image = STATION.p_dock * [1, -1, 1] + [0, 3.4, 0]
    p_cam = (image - T[:3, 3]) @ T[:3, :3]
    np.testing.assert_allclose(halos.p_cam, p_cam, atol=1e-12)
    np.testing.assert_allclose(cores.p_cam, np.repeat(p_cam, 2, axis=0), atol=1e-12)
    np.testing.assert_allclose(cores.at_lens.reshape(-1, 2, 3).sum(axis=1), halos.at_lens, rtol=1e-9)


def test_a_surface_mirrors_all_beyond_the_critical_angle_and_two_per_cent_from_below():
    """Textbook values: 2 % at normal incidence; total reflection beyond 48.3 degrees."""
    angles = np.deg2rad([0.0, 40.0, 48.0, 48.6, 70.0])
    back = surroundings.fresnel(np.cos(angles), 1.34)
    assert back[0] == pytest.approx(((1.34 - 1) / (1.34 + 1)) ** 2)
    assert back[0] < back[1] < back[2] < 1.0
    assert back[3:].tolist() == [1.0, 1.0]


# Pixels


@pytest.mark.parametrize("window_px", [0.3, 1.7, 6.0, 25.0])
def test_core_profile_keeps_its_light_and_its_centre(window_px):
    at = np.array([0.37, -0.21])
    pixels = np.arange(-40, 41)
    shares = core_profile(pixels - at[0], pixels - at[1], window_px, 0.7).astype(float)
    assert shares.sum() == pytest.approx(1.0, abs=2e-3)
    centre = [(shares * pixels[None, :]).sum(), (shares * pixels[:, None]).sum()] / shares.sum()
    np.testing.assert_allclose(centre, at, atol=0.005)


def centroid(picture, near, sigma):
    """Centroid by moments under a Gaussian window that is centred on it; a symmetric image gives no bias."""
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    at = near.copy()
    for _ in range(60):
        weight = picture * np.exp(-0.5 * ((u - at[0]) ** 2 + (v - at[1]) ** 2) / sigma**2)
        mean = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
        at = at + 2.0 * (mean - at)
    return at


@pytest.mark.parametrize("distance_m", [2.5, 6.0, 18.0])
@pytest.mark.parametrize("scattering", [0.0, 0.29])
def test_centre_of_an_isolated_light_is_where_truth_says(distance_m, scattering, rng):
    camera = Camera(400, 400, np.array([[2087.0, 0, 199.5], [0, 2087.0, 199.5], [0, 0, 1]]))
    lens = lens_of(camera=camera)
    for offset in rng.uniform(-0.004, 0.004, (6, 2)):
        seen = lamp(np.append(offset, 1.0) * distance_m, lens=lens)
        picture = drawn(seen, np.full(3, 0.1), np.full(3, scattering), lens=lens).astype(float)
        sigma = 1.5 + 0.6 * seen.window_px[0]
        assert np.abs(centroid(picture, seen.uv[0], sigma) - seen.uv[0]).max() < 0.005


def test_a_moving_lamp_is_drawn_along_its_way():
    shares = core_profile(np.arange(-20, 21), np.arange(-20, 21), 1.0, 0.7, np.array([12.0, 0.0]))
    across, along = shares.sum(axis=1), shares.sum(axis=0)
    assert np.ptp(np.flatnonzero(along > 0.5 * along.max())) == pytest.approx(12, abs=1)
    assert np.ptp(np.flatnonzero(across > 0.5 * across.max())) <= 3
    assert (shares * np.arange(-20, 21)).sum() == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("gain_db", [0.0, 6.0])
def test_noise_follows_the_photon_transfer_curve(gain_db):
    """Variance over mean is levels per electron; what is left is read noise and rounding. Source: EMVA 1288."""
    settings = knobs.Sensor(gain_db=gain_db)
    per_level = 10700.0 / 4095.0 / 10 ** (gain_db / 20.0)
    means, variances = [], []
    for electrons in (30.0, 300.0, 1000.0, 2500.0, 4000.0):
        raw = sensor.read_out(np.full((500, 500), electrons, np.float32), settings, np.random.default_rng(1)).astype(
            float
        )
        means.append(raw.mean())
        variances.append(raw.var())
        assert raw.mean() == pytest.approx(electrons / per_level, rel=0.002)
    slope = np.polyfit(means, variances, 1)[0]
    assert slope == pytest.approx(1.0 / per_level, rel=0.02)
    np.testing.assert_allclose(variances[0], 30.0 / per_level**2 + (2.3 / per_level) ** 2 + 1 / 12, rtol=0.02)
    full = sensor.read_out(np.full((100, 100), 1e5, np.float32), settings, np.random.default_rng(1))
    assert full.max() == 4095
    assert full.min() > 4080


@pytest.mark.parametrize("place", [(0.0, 0.0, 4.0), (1.2, -0.8, 4.0)])
def test_a_halo_is_on_the_picture_what_it_is_in_the_table(place):
    """On all three canvases, at the centre of the picture and near its corner, where pixels see less."""
    lens, seen = lens_of(), lamp(place, (0.0, 1e4, 0.0), radius_m=1e-4)
    picture = drawn(seen, (1.0, 0.1, 1.0), (0.0, 0.3, 0.0), "harbour")
    theta, values = halo(0.1, 0.3, "harbour", float(f"{seen.range_m[0]:.3g}"))
    alone = seen.at_lens[0, 1] / lens.throughput(seen.uv)[0] * 0.65
    ray = lens.rays(seen.uv)[0]
    for reach_px in (12, 40, 90, 200, 400, 700):
        for turn in np.arange(0.0, 2 * np.pi, 0.7):
            at = np.round(seen.uv + reach_px * np.array([[np.cos(turn), np.sin(turn)]]))
            if not CAMERA.contains(at, margin_px=20)[0]:
                continue
            angle = np.arccos(lens.rays(at)[0] @ ray)
            share = np.exp(np.interp(np.log(angle), np.log(theta), np.log(values)))
            wanted = alone * share * lens.solid_angle(at)[0] * lens.throughput(at)[0]
            assert picture[int(at[0, 1]), int(at[0, 0])] == pytest.approx(wanted, rel=0.05), (reach_px, turn)
