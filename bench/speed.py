"""Milliseconds from pixels to detections and to a fix, beside one pass over the frame and what others use; one core.

Everything is timed in one process, in turns, in CPU time of the thread; before each timing the caches are filled with
something else. "passes" are multiples of `np.max` over the same frame as mono.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock import detect, layers, match
from lumidock.config import Config
from lumidock.datatypes import Detections, Frame
from lumidock.localizer import Localizer
from lumidock.model import attitude_prior, measurements, station_model
from lumidock.paper import PaperLocalizer
from lumidock.station import Station
from lumidock.streams.sources import open_source

_Z_M, _ROUNDS, _SEED, _STARTS = (18.0, 9.0, 2.3), 7, 7100, 3
_LIGHTS, _SPURIOUS = (7, 13, 25, 50), (0, 2, 10, 50)
_OUTPUT = {
    "mono8": ("output.pixels=mono8", "output.color=false", "output.file=png"),
    "bayer_rggb8": ("output.pixels=bayer8", "output.file=png"),
    "bgr8": (),
}
_OTHERS = np.ones(1 << 26, np.uint8)  # zeros that nobody wrote are one page
Times = dict[str, list[float]]


def simulate(z_m: float, kind: str, out: Path) -> None:
    """Render some consecutive frames of the approach around a distance, as a camera of this kind gives them."""
    command = [sys.executable, "-m", "lumidock", "sim", "approach", "--seed", str(_SEED), "--out", str(out)]
    for setting in (f"path.start_z_m={z_m + 0.6}", f"path.end_z_m={z_m - 0.3}", *_OUTPUT[kind]):
        command += ["--set", setting]
    subprocess.run(command, check=True, capture_output=True)


def sequence(z_m: float, kind: str) -> list[Frame]:
    """These frames, decoded."""
    with TemporaryDirectory() as name:
        simulate(z_m, kind, Path(name) / "s")
        return [frame for frame in open_source(Path(name) / "s").items() if isinstance(frame, Frame)]


def timed(times: Times, name: str, job: Callable[[], object]) -> None:
    """Add the milliseconds of a job that finds cold caches."""
    _OTHERS.max()
    start = time.thread_time()
    job()
    times[name].append(1e3 * (time.thread_time() - start))


def lumidock_round(times: Times, frames: list[Frame]) -> None:
    """One run over the frames: first frame searched in full, later ones where the track holds."""
    localizer, config = Localizer(shipped_station(), shipped_camera()), Config()
    full = detect.Scan(frames[0], config.detect)
    timed(times, "np.max over it", lambda: frames[0].image.max())

    def find(frame: Frame, scan: detect.Scan, expected: np.ndarray | None) -> None:
        layers.label(frame, detect.lights(frame, config.detect, scan, expected), config.label)

    for frame in frames:
        expected = localizer.search_windows(frame)
        if expected is None:
            timed(times, "full search", lambda f=frame: find(f, full, None))
            timed(times, "full search to fix", lambda f=frame: localizer.process(f))
            continue
        assert localizer.scan is not None
        timed(times, "tracked search", lambda f=frame, e=expected: find(f, localizer.scan, e))
        timed(times, "tracked search to fix", lambda f=frame: localizer.process(f))


def blobs_and_pnp(frame: Frame) -> None:
    """What many write first: OpenCV's blobs and a pose from the lights as if all were named."""
    parameters = cv2.SimpleBlobDetector_Params()
    parameters.filterByColor, parameters.blobColor = True, 255
    parameters.filterByArea, parameters.minArea = True, 4.0
    cv2.SimpleBlobDetector_create(parameters).detect(frame.image)
    station, camera = shipped_station(), shipped_camera()
    uv = camera.project(station.p_dock * (1.0, -1.0, -1.0) + (0.0, 0.0, 9.0))
    uv = np.asarray(uv[0] if isinstance(uv, tuple) else uv)
    matrix = np.array([[camera.focal_px[0], 0, 1224], [0, camera.focal_px[1], 1024], [0, 0, 1.0]])
    cv2.solvePnP(station.p_dock, uv, matrix, np.zeros(4), flags=cv2.SOLVEPNP_SQPNP)


def april_tags(frame: Frame) -> None:
    """AprilTag 36h11 on the same frame."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cv2.aruco.ArucoDetector(tags, cv2.aruco.DetectorParameters()).detectMarkers(frame.image)


def growth(spurious: tuple[int, ...]) -> dict[str, float]:
    """Median ms of a full search of a frame with so many blobs, of pure noise and of the most blobs that fit."""
    rng, config, found = np.random.default_rng(_SEED), Config(), {}
    for count in (*spurious, 10_000, 0):
        image = rng.normal(20.0, 30.0 if count == 0 else 2.0, (2048, 2448))
        for u, v in rng.uniform(12, 2030, (count, 2)).astype(int):
            image[v - 3 : v + 4, u - 3 : u + 4] += 120.0 * _BLOB
        frame = Frame("0", 0, np.clip(image, 0, 255).astype(np.uint8))
        scan, times = detect.Scan(frame, config.detect), defaultdict(list)
        for _ in range(5):
            timed(times, "search", lambda f=frame, s=scan: detect.lights(f, config.detect, s))
        found["pure noise" if count == 0 else f"{count} blobs"] = float(np.median(times["search"]))
    return found


def matching_growth(lights: tuple[int, ...], spurious: tuple[int, ...]) -> dict[int, dict[int, tuple[float, float]]]:
    """Median and largest ms of associating one frame, by lights, then spurious detections; some are dark.

    The lights stand anywhere on two planes 5 m apart, as many on either, and are seen from 9 m without colour.
    """
    rng, camera, config = np.random.default_rng(_SEED), shipped_camera(), Config()
    grown: dict[int, dict[int, tuple[float, float]]] = {m: {} for m in lights}
    for m in lights:
        station = dense_station(m, rng)
        model, expected = station_model(station, camera, config.match), attitude_prior(None, config.prior)
        uv = camera.project(station.p_dock * (1.0, -1.0, -1.0) + (0.2, 0.1, 9.0))
        for count in spurious:
            times: Times = defaultdict(list)
            for turn in range(_DRAWS + 1):
                shown = (uv + rng.normal(0.0, 0.3, (m, 2)))[rng.random(m) < 0.9]
                spurious = rng.uniform((0.0, 0.0), (camera.width, camera.height), (count, 2))
                found = measurements(Detections.from_uv("0", 0, np.concatenate([shown, spurious])), model, config.match)
                timed(
                    times if turn else defaultdict(list),
                    "match",
                    lambda f=found, p=model, e=expected: match.acquire(f, p, camera, e, config.match),
                )
            grown[m][count] = float(np.median(times["match"])), max(times["match"])
    return grown


def dense_station(lights: int, rng: np.random.Generator) -> Station:
    """A dock of so many lights at random, 0.15 m apart at least, on two planes of 2 x 2 m."""
    p: list[np.ndarray] = []
    while len(p) < lights:
        place = np.array([*rng.uniform(-1.0, 1.0, 2), -5.0 * (len(p) % 2)])
        if all(np.linalg.norm(place - other) > 0.15 for other in p):
            p.append(place)
    one = shipped_station()
    return replace(
        one,
        name=f"random-{lights}",
        ids=tuple(f"L{k}" for k in range(lights)),
        layers=("front", "rear"),
        layer=np.arange(lights) % 2,
        p_dock=np.array(p),
        color=("white",) * lights,
        axis=np.tile([0.0, 0.0, 1.0], (lights, 1)),
        beam_deg=np.full(lights, 120.0),
        power_w=np.full(lights, 2.0),
    )


_DRAWS = 9
_BLOB = np.exp(-0.5 * (np.arange(-3, 4)[:, None] ** 2 + np.arange(-3, 4)[None] ** 2) / 1.5**2)

_START = """
import time; start = time.perf_counter()
import numpy as np
from bench.shipped import shipped_camera, shipped_station
from lumidock import Frame, Localizer
localizer = Localizer(shipped_station(), shipped_camera())
image = np.load({path!r})
for k in range(3):
    localizer.process(Frame(str(k), k * 150_000_000, np.ascontiguousarray(np.roll(image, k, axis=0))))
print(time.perf_counter() - start)
"""
_PEAK = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, capture_output=True)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0)
"""


def start_up(frame: Frame) -> tuple[float, float]:
    """Seconds to the third frame with empty and with warm caches of compiled code."""
    with TemporaryDirectory() as name:
        np.save(f"{name}/frame.npy", frame.image)
        code = _START.format(path=f"{name}/frame.npy")
        environment = os.environ | {"NUMBA_CACHE_DIR": f"{name}/cache"}
        runs = []
        for _ in range(1 + _STARTS):
            done = subprocess.run(
                [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment
            )
            runs.append(float(done.stdout))
    return runs[0], float(np.median(runs[1:]))


def peak_memory() -> float:
    """MiB of a process that runs over a folder of BGR frames and has nothing to compile."""
    with TemporaryDirectory() as name:
        simulate(9.0, "bgr8", Path(name) / "s")
        peaks = []
        for run in ("first", "second"):  # the first one may compile
            words = [sys.executable, "-m", "lumidock", "run", f"{name}/s", "--out", f"{name}/{run}"]
            done = subprocess.run([sys.executable, "-c", _PEAK, *words], check=True, capture_output=True, text=True)
            peaks.append(float(done.stdout))
    return peaks[1]


def main() -> tuple[dict[str, object], list[str]]:
    """Medians over rounds in turns: a row a job, a column a distance."""
    cv2.setNumThreads(1)
    frames = {(z, kind): sequence(z, kind) for z in _Z_M for kind in _OUTPUT}
    times: dict[tuple[float, str], Times] = defaultdict(lambda: defaultdict(list))
    for turn in range(_ROUNDS + 1):
        if turn == 1:  # the first one compiled
            times.clear()
        for key, some in frames.items():
            lumidock_round(times[key], some)
            if key[1] == "bgr8" and turn < 4:
                timed(
                    times[key],
                    "paper's method",
                    lambda f=some[0]: PaperLocalizer(shipped_station(), shipped_camera()).process(f),
                )
            if key[1] == "mono8" and turn < 4:
                timed(times[key], "SimpleBlobDetector + SQPnP", lambda f=some[0]: blobs_and_pnp(f))
                timed(times[key], "AprilTag 36h11", lambda f=some[0]: april_tags(f))
    one_pass = float(np.median([x for (_, kind), t in times.items() if kind == "mono8" for x in t["np.max over it"]]))
    lines = ["| ms (passes) | " + " | ".join(f"{z:g} m" for z in _Z_M) + " |", "|---|" + "---|" * len(_Z_M)]
    content: dict[str, object] = {"pass_ms": one_pass}
    for kind in _OUTPUT:
        for job in sorted({job for z in _Z_M for job in times[z, kind]}):
            medians = [float(np.median(times[z, kind][job])) if times[z, kind][job] else float("nan") for z in _Z_M]
            content[f"{kind}: {job}"] = medians
            lines.append(f"| {kind}: {job} | " + " | ".join(f"{m:.2f} ({m / one_pass:.1f})" for m in medians) + " |")
    content["growth_ms"] = grown = growth((2, 20, 200))
    content["matching_ms"] = named = matching_growth(_LIGHTS, _SPURIOUS)
    (cold_s, warm_s), peak = start_up(frames[9.0, "bgr8"][0]), peak_memory()
    content |= {"start_cold_s": cold_s, "start_warm_s": warm_s, "peak_mib": peak, "machine": machine()}
    lines += ["", "Full search of a mono frame, ms: " + ", ".join(f"{k} {v:.2f}" for k, v in grown.items()) + "."]
    lines += [
        "",
        "| associating a frame without history, ms: median / largest | "
        + " | ".join(map(str, _SPURIOUS))
        + " spurious |",
    ]
    lines += ["|---" * (len(_SPURIOUS) + 1) + "|"]
    for m, row in named.items():
        lines.append(f"| {m} lights | " + " | ".join(f"{a:.2f} / {b:.2f}" for a, b in row.values()) + " |")
    lines.append("")
    lines.append(
        f"Start to the third frame: {cold_s:.1f} s while compiling, {warm_s:.2f} s after; peak memory of a run over a "
        f"folder {peak:.0f} MiB."
    )
    lines += ["", machine()]
    return content, lines


def machine() -> str:
    """What the figures were measured on."""
    model = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        platform.machine(),
    )
    return f"Machine: {model}, one core, Python {platform.python_version()}, OpenCV {cv2.__version__}."
