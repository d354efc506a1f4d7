"""Figure 5 measured: front or rear by colour, by radius, or by both, on rendered frames of the paper's approach."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config, PaperConfig
from lumidock.datatypes import Array, Detections, Frame, Indices
from lumidock.paper import PaperLocalizer, extract
from lumidock.paper.layers import LayerDiscriminator, label_by_color
from lumidock.report.page import Table
from lumidock.reproduce.docking import span
from lumidock.reproduce.intervals import share
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Plan
from lumidock.reproduce.work import Simulation, first_and_last, over_limit, rendered_frames, true_lights
from lumidock.sim.detections import in_view
from lumidock.station import Station

RULES = {
    "color": "colour alone",
    "radius": "radius alone",
    "color_or_radius": "colour, radius where nothing is blue (as printed)",
    "auto": "colour, radius where there is none (recommended)",
}
PICTURES = ("colour", "gray")
_FROM_M = 13.0  # the rear lights come into view at some 10 m, so every rule begins with the front layer alone
_APPROACH_M = _FROM_M + 3.0
_FRAME_S = 0.25  # about what a rendered frame costs with all rules


def jobs(plan: Plan) -> list[Job]:
    """The near part of an approach."""
    interval_s = plan.grid.docking_interval_s
    settings = (f"path.start_z_m={_FROM_M:g}", f"path.frame_interval_s={interval_s}")
    simulation = Simulation(plan.dock, "approach", settings, plan.grid.first_seed)
    return [Job("layer-rules", _APPROACH_M / interval_s * _FRAME_S, measure, (simulation, plan.config))]


class _Score:
    """One rule on one kind of picture: what it has been right in so far."""

    def __init__(self, config: PaperConfig, station: Station, camera: Camera) -> None:
        self._discriminator = LayerDiscriminator(config.layers)
        self._localizer = PaperLocalizer(station, camera, config)
        rear = station.lights_of(station.layers_front_to_rear()[-1])
        self._is_rear = np.isin(np.arange(len(station)), rear)
        self._counts = Counter[str]()
        self._z_m: list[float] = []
        self._valid: list[bool] = []

    def add(self, detections: Detections, light: Indices, T_dock_cam: Array) -> None:
        """One frame, whose detections are of `light` (N,), -1 for none."""
        right_layer = self._discriminator.rear(detections) == self._is_rear[light]
        fix = self._localizer.process_detections(detections)
        given = np.full(len(light), -1) if fix.match is None else fix.match.light
        self._counts["detections"] += int((light >= 0).sum())
        self._counts["right_layer"] += int(right_layer[light >= 0].sum())
        self._counts["identified"] += int((given >= 0).sum())
        self._counts["wrong"] += int((given != light)[given >= 0].sum())
        self._counts["hazardous"] += fix.T_dock_cam is not None and over_limit(fix.T_dock_cam, T_dock_cam)
        self._z_m.append(float(T_dock_cam[2, 3]))
        self._valid.append(fix.valid)

    def result(self) -> dict[str, Any]:
        """As JSON."""
        ends = first_and_last(np.array(self._z_m), np.array(self._valid, bool))
        return dict(self._counts) | {"frames": len(self._z_m), "poses": sum(self._valid), "ends": ends}


def measure(simulation: Simulation, config: Config) -> dict[str, Any]:
    """The paper's method, recommended but for the rule, on the same detections of colour and of gray pictures."""
    _, station, camera = simulation.load()
    scores = {
        (kind, rule): _Score(_with_rule(config.paper, rule), station, camera) for kind in PICTURES for rule in RULES
    }
    for T_dock_cam, frame in rendered_frames(simulation):
        uv, seen = in_view(station, camera, T_dock_cam)
        uv[~seen] = np.nan
        for kind in PICTURES:
            detections = _detections(frame if kind == "colour" else _gray(frame), config.paper)
            light = true_lights(detections, uv)
            for rule in RULES:
                scores[kind, rule].add(detections, light, T_dock_cam)
    return {kind: {rule: scores[kind, rule].result() for rule in RULES} for kind in PICTURES}


def _with_rule(config: PaperConfig, rule: str) -> PaperConfig:
    return config.model_copy(update={"layers": config.layers.model_copy(update={"method": rule})})


def _gray(frame: Frame) -> Frame:
    return replace(frame, image=cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY))


def _detections(frame: Frame, config: PaperConfig) -> Detections:
    return label_by_color(frame, extract.lights(frame, config.extract), config.layers)


def table(results: Mapping[str, Any]) -> Table:
    """A row for each kind of picture and rule."""
    rows = []
    for kind, by_rule in results["layer-rules"].items():
        for rule, r in by_rule.items():
            poses = f"{r['poses']} of {r['frames']}"
            wrong = f"{r['wrong']} of {r['identified']}"
            right = share(r["right_layer"], r["detections"])
            rows.append([f"{kind} picture: {RULES[rule]}", right, poses, span(r["ends"]), wrong, str(r["hazardous"])])
    head = [
        "front or rear by",
        "detections in the right layer, %",
        "frames with a pose",
        "from and to z, m",
        "wrong identities",
        "poses over their alert limit",
    ]
    caption = (
        f"Figure 5: rules that tell front from rear, on rendered frames from {_FROM_M:g} to -3 m in Jerlov III water, "
        "the paper's method in the recommended preset but for the rule."
    )
    return Table(caption, head, rows)
