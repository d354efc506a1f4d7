"""Matter in the simulator against closed forms, brute force and what the water does without it."""

import csv
import filecmp
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station
from hypothesis import given, settings
from hypothesis import strategies as st

from lumidock._kernels.rendering import render as kernel
from lumidock._kernels.rendering.raycast import FAR_M
from lumidock._kernels.rendering.shading import Lights, LitScene, Medium
from lumidock.camera import Camera
from lumidock.errors import InputError
from lumidock.sim.knobs import Output
from lumidock.sim.matter import FINISHES, Finish, Matter, Solid
from lumidock.sim.matter_renderer import compact_points
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, load_scenario
from lumidock.sim.schedule import schedule_of
from lumidock.sim.sequence import write_rendered
from lumidock.sim.solids import SolidScene
from lumidock.sim.video import as_video, seen_by_field, woven
from lumidock.streams.images import read_image

STATION, CAMERA = shipped_station(), shipped_camera()
SMALL = Camera(306, 256, CAMERA.K / [[8.0], [8.0], [1.0]], CAMERA.model, CAMERA.distortion)
MATT = Finish(albedo=(0.5, 0.5, 0.5))
GLOSSY = Finish(albedo=(0.0, 0.0, 0.0), gloss=0.5, shininess=400.0)
CLEAR = (0.0, 0.0, 0.0)


def lamp(p_cam, watt_sr=1.0):
    """One lamp that shines evenly all around and has no extent."""
    even = np.full((1, 3), watt_sr)
    return Lights(np.array([p_cam]), np.array([[0.0, 0.0, 1.0]]), 0.0 * even, even, np.ones(1), np.zeros(1))


def water(beam=CLEAR):
    """Water at night."""
    none = np.zeros((2, 3))
    return Medium(
        beam=np.array(beam),
        surface=np.zeros(3),
        decay=np.ones(3),
        up=np.array([0.0, -1.0, 0.0]),
        depth_m=10.0,
        sideways=none,
        lamp_sr=np.zeros((0, 2, 2, 3)),
        edge_m=np.zeros(0),
    )


def seen(parts, finish, lights, medium=None, half=0.2, blocks=4, middle=(0.0, 0.0)):
    """Radiance (n, n, 3), ranges (n, n) and rays (n, n, 3) of solids in `cam`, over tangents `half` around a middle."""
    scene = SolidScene.of([part.model_copy(update={"frame": "cam", "finish": "it"}) for part in parts],
                     Matter(finishes={"it": finish}))  # fmt: skip
    solids = scene.solids(np.eye(4))
    side = blocks * kernel.BLOCK
    grid = np.linspace(-half, half, blocks + 1)
    x, y = np.meshgrid(grid + middle[0], grid + middle[1])
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    sight = kernel.Sight(rays, np.ones(x.shape), np.eye(3), 4.0 * half / blocks, 2.0 * half / side, float(kernel.BLOCK))
    world = LitScene(solids, scene.surfaces(), lights, medium or water(), faint=1e-9,
                     blockers=kernel.no_blockers(len(lights.exponent), len(solids.kind)),
                     noise=np.zeros((2, 2)))  # fmt: skip
    picture = kernel.Picture(
        np.empty((side, side, 3), np.float32), np.empty((side, side), np.float32),
        np.zeros((blocks, blocks, 3), np.float32),
    )  # fmt: skip
    kernel.render(world, sight, kernel.scratch(len(solids.kind)), picture)
    fine = np.arange(side) * 2.0 * half / side - half
    x, y = np.meshgrid(fine + middle[0], fine + middle[1])
    ray = np.stack([x, y, np.ones_like(x)], axis=-1)
    return picture.electrons, picture.range_m, ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def wall(z):
    return Solid(kind="box", center=(0.0, 0.0, z + 0.5), half_m=(50.0, 50.0, 0.5))


# Light on surfaces


@pytest.mark.parametrize("height", [0.05, 0.5, 2.0])
def test_a_lamp_over_a_plane_lights_it_by_cosine_inverse_square_and_attenuation(height):
    beam, z, power = np.array([0.1, 0.3, 0.6]), 3.0, 2.0
    place = np.array([0.1, -0.2, z - height])
    light, range_m, rays = seen([wall(z)], MATT, lamp(place, power), water(beam))
    p = rays * (z / rays[..., 2:])
    np.testing.assert_allclose(range_m, np.linalg.norm(p, axis=-1), rtol=1e-5)
    r = np.linalg.norm(p - place, axis=-1)[..., None]
    falling = power * (height / r) / r**2 * np.exp(-beam * r)
    wanted = 0.5 / np.pi * falling * np.exp(-beam * range_m[..., None])
    np.testing.assert_allclose(light[::16, ::16], wanted[::16, ::16], rtol=1e-4)  # corners of blocks are never blended
    np.testing.assert_allclose(light, wanted, rtol=0.12, atol=0.02 * wanted.max())


@pytest.mark.parametrize("phase_deg", [0.0, 45.0, 90.0, 130.0])
def test_a_matt_sphere_has_the_phases_of_lambert(phase_deg):
    far, radius, phase = 90.0, 0.5, np.deg2rad(phase_deg)
    away = 90.0
    center = np.array([0.0, 0.0, far])
    place = center + away * np.array([np.sin(phase), 0.0, -np.cos(phase)])
    ball = Solid(kind="ellipsoid", center=tuple(center), half_m=(radius,) * 3)
    if phase_deg == 0.0:
        place = center - [0.0, 0.0, far]  # the lamp at the camera
    half = 0.008
    light, _, rays = seen([ball], MATT, lamp(place, away**2), half=half, blocks=8)
    sr = (2.0 * half / len(rays)) ** 2 * rays[..., 2] ** 3
    total = float((light[..., 0] * sr).sum())
    wanted = 0.5 * (radius / far) ** 2 * 2.0 / (3.0 * np.pi) * (np.sin(phase) + (np.pi - phase) * np.cos(phase))
    assert total == pytest.approx(wanted, rel=0.04)


def test_a_glossy_wall_is_brightest_where_it_mirrors_the_lamp():
    z, place = 4.0, np.array([1.2, -0.6, 0.0])  # beside the camera, so that half-vector and mirror agree
    light, _, rays = seen([wall(z)], GLOSSY, lamp(place), half=0.3, blocks=8)
    row, column = np.unravel_index(np.argmax(light[..., 0] * 1.0), light.shape[:2])
    p = rays[row, column] * z / rays[row, column, 2]
    mirror = 0.5 * place[:2]
    np.testing.assert_allclose(p[:2], mirror, atol=0.04)


@given(st.floats(1.0, 5e3), st.floats(0.0, 1.4))
@settings(max_examples=40, deadline=None)
def test_the_glossy_lobe_reflects_all_that_comes_head_on_and_never_more(shininess, tilt):
    """The integral of the lobe times the cosine over the hemisphere, on a grid around the mirrored direction."""
    light = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    near = np.geomspace(1e-4, 1.0, 400) * np.pi
    edges = np.concatenate([[0.0], near])
    theta, azimuth = 0.5 * (edges[1:] + edges[:-1]), (np.arange(180) + 0.5) * 2.0 * np.pi / 180
    mirror = light * [-1.0, -1.0, 1.0]
    x = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    frame = np.stack([x, np.cross(mirror, x), mirror])
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    around = (sine * np.cos(azimuth), sine * np.sin(azimuth), np.broadcast_to(cosine, (len(theta), len(azimuth))))
    view = np.stack(around, axis=-1) @ frame
    half = view + light
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    out = np.zeros(view[..., 0].size)
    kernel.lobes(np.full(out.shape, shininess), np.ascontiguousarray(half[..., 2].ravel()), out)
    ring = (np.cos(edges[:-1]) - np.cos(edges[1:]))[:, None] * 2.0 * np.pi / 180
    total = float((out.reshape(view.shape[:2]) * np.maximum(view[..., 2], 0.0) * ring).sum())
    assert total <= 1.01
    if tilt == 0.0:
        assert total == pytest.approx(1.0, abs=0.01)


def test_head_on_the_glossy_lobe_reflects_all():
    test = test_the_glossy_lobe_reflects_all_that_comes_head_on_and_never_more.hypothesis.inner_test
    for shininess in (1.0, 20.0, 300.0, 5e3):
        test(shininess, 0.0)


# What hides what


def some_solids(rng, count):
    kinds, parts = ("box", "tube", "ring", "ellipsoid"), []
    for _ in range(count):
        center = tuple(rng.uniform([-1.5, -1.5, 1.0], [1.5, 1.5, 6.0]))
        end = tuple(np.array(center) + rng.uniform(-1.5, 1.5, 3))
        radii = tuple(np.sort(rng.uniform(0.01, 0.4, 2)))
        parts.append(Solid(kind=str(rng.choice(kinds)), center=center, end=end, axis=tuple(rng.normal(size=3)),
                           half_m=tuple(rng.uniform(0.02, 0.5, 3)), radius_m=radii))  # fmt: skip
    return parts


def nearest(parts, origin, rays):
    """Ranges (N,) of the first hits of `rays` (N, 3) from an origin (3,), by trying every solid."""
    moved = [
        part.model_copy(update={"frame": "cam", "center": tuple(np.array(part.center) - origin),
                                "end": tuple(np.array(part.end) - origin)}) for part in parts
    ]  # fmt: skip
    range_m, which = np.zeros(len(rays)), np.zeros(len(rays), np.int64)
    kernel.first_hits(SolidScene.of(moved, Matter()).solids(np.eye(4)), np.ascontiguousarray(rays), range_m, which)
    return range_m


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_a_picture_shows_what_brute_force_finds(seed):
    parts = some_solids(np.random.default_rng(seed), 12)
    _, range_m, rays = seen(parts, MATT, lamp((0.0, 0.0, 0.0)), half=0.5, blocks=6)
    np.testing.assert_allclose(range_m.ravel(), nearest(parts, np.zeros(3), rays.reshape(-1, 3)), rtol=2e-5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_shadows_fall_where_brute_force_finds_something_before_the_lamp(seed):
    rng = np.random.default_rng(seed)
    parts, place = some_solids(rng, 8), np.array([*rng.uniform(-1.0, 1.0, 2), -0.5])
    parts = [part.model_copy(update={"center": (*part.center[:2], part.center[2] - 0.9)}) for part in parts]
    light, range_m, rays = seen([wall(7.0), *parts], MATT, lamp(place), half=0.5, blocks=6)
    p = (rays * range_m[..., None])[:: kernel.BLOCK, :: kernel.BLOCK].reshape(-1, 3)
    on_wall = np.abs(p[:, 2] - 7.0) < 1e-4
    way = p - place
    length = np.linalg.norm(way, axis=1)
    free = nearest(parts, place, way / length[:, None]) > length
    lit = light[:: kernel.BLOCK, :: kernel.BLOCK, 0].ravel() > 0.0
    # a block that shows several surfaces copies the light of a flat one over four samples: its first sample is its own
    np.testing.assert_array_equal(lit[on_wall], free[on_wall])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_normals_stand_across_the_surface(seed):
    """A closed solid in an even glow from the camera is nowhere brighter than where it faces it."""
    rng = np.random.default_rng(seed)
    part = some_solids(rng, 1)[0].model_copy(update={"kind": "ellipsoid"})
    light, range_m, _ = seen([part], MATT, lamp((0.0, 0.0, 0.0)), half=1.6, blocks=6)
    hit = range_m < FAR_M
    most = 0.5 / np.pi / range_m[hit] ** 2
    assert (light[hit][:, 0] <= 1.2 * most + 1e-6).all()


# In scenes


def head_on(z):
    T = np.eye(4)
    T[:3, :3] = R_DOCK_CAM_HEAD_ON
    T[2, 3] = z
    return T


def shot_of(scenario, z, camera=SMALL):
    plan = schedule_of(scenario, STATION, camera, 0)
    return plan.renderer(0).expect(replace(plan.conditions(0), T_dock_cam=head_on(z), T_cam_later=np.eye(4)))


@pytest.mark.parametrize("name", ["approach", "headlamp", "shallow"])
def test_water_is_the_same_beside_matter_as_without_it(name):
    """A box behind the camera changes the code that draws the water, and nothing that it draws."""
    bare = load_scenario(name, ("lamps.dim=0",))
    box = Solid(kind="box", center=(0.0, 0.0, 30.0))
    beside = bare.model_copy(update={"matter": Matter(solids=(box,))})
    want, have = shot_of(bare, 8.0).electrons, shot_of(beside, 8.0).electrons
    cells = [e[:256, :304].reshape(32, 8, 38, 8).mean(axis=(1, 3)) for e in (want, have)]
    np.testing.assert_allclose(cells[1][2:-2, 2:-2], cells[0][2:-2, 2:-2], rtol=0.03, atol=0.02)


def test_a_solid_hides_the_lamps_behind_it_and_their_halo():
    scenario = load_scenario("approach", ("daylight.surface_w_m2=0",))
    p = STATION.p_dock[0]
    plate = Solid(
        kind="box", center=(p[0] * 2.0 / 3.0, p[1] * 2.0 / 3.0, 2.0), half_m=(0.25, 0.25, 0.01), finish="black"
    )
    hidden = scenario.model_copy(update={"matter": Matter(solids=(plate,))})
    bare, covered = shot_of(scenario, 6.0), shot_of(hidden, 6.0)
    assert bare.snr[0] > 50.0
    assert covered.snr[0] == 0.0
    np.testing.assert_allclose(covered.snr[6], bare.snr[6], rtol=0.1)
    u, v = np.round(bare.emitters.uv[0]).astype(int)
    assert covered.electrons[v, u] < 0.8 * bare.electrons[v, u]


@pytest.mark.parametrize("dock", ["cage", "funnel", "plate"])
def test_no_dock_hides_its_own_lamps_from_ahead(dock):
    scenario = load_scenario("approach").model_copy(update={"matter": Matter(dock=dock)})
    front = STATION.lights_of("front")
    assert (shot_of(scenario, 5.0, CAMERA).snr[front] > 8.0).all()


def test_a_lamp_lights_what_carries_it():
    """Beside a lamp that stands out from a white plate, the plate gets more of its light than further away."""
    p = STATION.p_dock[3]
    plate = Solid(kind="box", center=(0.0, 0.0, -0.06), half_m=(2.0, 2.0, 0.01), finish="white")
    scene = load_scenario("approach", ("daylight.surface_w_m2=0", "lamps.side_share=0.1", "lens.glare=0"))
    scene = scene.model_copy(update={"matter": Matter(solids=(plate,))})
    lit = shot_of(scene, 4.0, CAMERA)
    dark = shot_of(scene.model_copy(update={"lamps": scene.lamps.model_copy(update={"side_share": 0.0})}), 4.0, CAMERA)
    added = lit.electrons - dark.electrons
    u, v = lit.emitters.uv[3]
    px_per_m = float(CAMERA.K[0, 0]) / 4.06
    near, far = (added[int(v + out * px_per_m), int(u)] for out in (-0.1, -0.5))
    assert p[2] == 0.0
    assert near > 5.0 * max(far, 1e-3) > 0.0


def test_the_same_seed_gives_the_same_bytes_on_one_worker_or_two(tmp_path):
    scenario = load_scenario("cage-matter", ("path.start_z_m=4", "path.end_z_m=2", "path.frame_interval_s=1.0"))
    for folder, workers in (("one", 1), ("two", 2)):
        write_rendered(scenario, STATION, SMALL, 5, tmp_path / folder, workers=workers)
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    same, different, _ = filecmp.cmpfiles(tmp_path / "one", tmp_path / "two", files, shallow=False)
    assert len(same) == len(files)
    assert not different


def test_a_screw_is_noted_as_a_reflection_and_an_edge_is_not():
    picture = np.full((200, 300), 100.0, np.float32)
    picture[:, :150] = 900.0
    picture[100, 220:223] = picture[101, 220:223] = 4000.0
    points = compact_points(picture, 2.0)
    assert len(points) == 1
    np.testing.assert_allclose(points[0], [221.0, 100.5], atol=1.0)


# The files of a scenario, and the camera


def test_a_finish_that_gives_more_light_than_comes_is_refused():
    with pytest.raises(InputError, match="albedo and gloss"):
        load_scenario("approach", ("matter.finishes={it: {albedo: [0.9, 0.9, 0.9], gloss: 0.2}}",))
    with pytest.raises(InputError, match="gold: no such finish"):
        load_scenario("approach", ("matter.solids=[{kind: box, finish: gold}]",))
    assert all(max(*f.albedo, *f.second) + f.gloss <= 1.0 for f in FINISHES.values())


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_single_field_has_half_the_rows_and_its_truth_fits_its_camera(tmp_path):
    frames = ("path.start_z_m=6", "path.end_z_m=5", "path.frame_interval_s=1.0", "output.file=png")
    for fields in ("none", "single"):
        scenario = load_scenario("approach", (*frames, f"output.fields={fields}"))
        write_rendered(scenario, STATION, SMALL, 1, tmp_path / fields, workers=1)
    whole, half = (read_image(tmp_path / fields / "frames" / "000000.png") for fields in ("none", "single"))
    np.testing.assert_array_equal(half, whole[::2])
    for a, b in zip(rows_of(tmp_path / "none" / "lights_truth.csv"), rows_of(tmp_path / "single" / "lights_truth.csv"),
                    strict=True):  # fmt: skip
        assert float(b["v_px"]) == pytest.approx(0.5 * float(a["v_px"]), abs=1e-3)
        assert b["u_px"] == a["u_px"]
    camera = seen_by_field(SMALL, Output(fields="single"))
    p = np.array([[0.3, -0.2, 2.0]])
    np.testing.assert_allclose(camera.project(p), SMALL.project(p) * [1.0, 0.5], atol=1e-9)


def test_woven_fields_are_those_of_two_moments(tmp_path):
    frames = ("path.kind=rectangle", "path.start_z_m=6", "path.speed_m_s=2.0", "path.frame_interval_s=3.0")
    for fields in ("none", "woven"):
        scenario = load_scenario("approach", (*frames, f"output.fields={fields}", "output.field_s=0.04"))
        write_rendered(scenario, STATION, SMALL, 1, tmp_path / fields, workers=1)
    still, moving = (rows_of(tmp_path / fields / "lights_truth.csv") for fields in ("none", "woven"))
    for a, b in zip(still, moving, strict=True):
        assert float(b["u_px"]) == pytest.approx(float(a["u_px"]), abs=0.05)  # the middle of the two
        assert float(b["v_px"]) == pytest.approx(float(a["v_px"]), abs=0.05)
    first, second = np.zeros((4, 6), np.uint8), np.ones((4, 6), np.uint8)
    np.testing.assert_array_equal(woven(first, second)[:, 0], [0, 1, 0, 1])


def test_video_keeps_grey_and_halves_colour(rng):
    grey = np.repeat(rng.integers(0, 256, (40, 50, 1), np.uint8), 3, axis=2)
    halved = as_video(grey, Output(chroma="half"))
    assert np.abs(halved.astype(int) - grey).max() <= 2
    stripes = np.zeros((40, 50, 3), np.uint8)
    stripes[:, ::2, 0] = 255
    stripes[:, 1::2, 2] = 255
    blended = as_video(stripes, Output(chroma="half")).astype(int)
    assert np.abs(blended[:, ::2, 0] - blended[:, 1::2, 0]).max() < 100
    narrow = as_video(grey, Output(levels="16-235"))
    assert narrow.min() >= 16
    assert narrow.max() <= 235
    with pytest.raises(InputError, match="video"):
        load_scenario("approach", ("output.pixels=bayer8", "output.file=png", "output.chroma=half"))
