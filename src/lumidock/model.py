"""What is known before a frame and of its detections, in the form that acquisition, association and filter take."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lumidock._kernels.measurements import Appearance, Measurements, weigh
from lumidock._kernels.tracking.track import Lights
from lumidock.camera import Camera
from lumidock.config import MatchConfig, PriorConfig
from lumidock.datatypes import Array, Attitude, Detections, Indices
from lumidock.light_counts import MAX_SUBSETS
from lumidock.station import Station

_OPEN_ROLL_RAD = math.pi  # 1 sigma of a roll of which nothing is known
_HEAD_ON = np.diag([1.0, -1.0, -1.0])  # R_dock_cam of a camera that looks straight into the dock
P_LAMP, _P_USUAL = 0.5, 0.15  # p_light above which a detection counts as a lamp; under which its centroid is doubtful
LEAST_P_LIGHT = 0.01  # a detection that is less likely a lamp leaves every answer as if it were not there
_IMPOSSIBLE = -1e9  # log likelihood ratio
_MOST_RADIUS_PX = 3.0  # px; of a detection without a radius, and the most that makes a doubtful centroid worse
_FLAT = 0.05  # a layer less thick than this share of its width is a plane


class PairOrder(NamedTuple):
    """The order in which the search tries pairs of lights.

    `rank` (M,): place of a light in its layer's order, in which each light is far from those before it. `pairs` (S, 2):
    lights of one layer. `unseen` (S,): the most lights of one layer that an association without the pairs before can
    hold.
    """

    rank: Indices
    pairs: Indices
    unseen: Indices


@dataclass(frozen=True, slots=True, eq=False)
class StationModel:
    """A station of M lights in L layers and the camera that sees it.

    `lights`: lens, positions m and beam axes. `layer` (M,) of each light; `is_rear` (L,) 1 for the rearmost layer.
    `group` (M,): the light, or the group of many, that one state of the bank is blind to.
    `survey_m2` (M,): variance m^2 of a position against the front layer. `planes` (L, 6): a point and the normal of
    each layer's plane, NaN for a layer with depth. `log_volume`: log of the volume m^3 of the view cone.
    `sigma_focal`: relative 1-sigma error of the focal length.
    """

    lights: Lights
    layer: Indices
    n_layers: int
    is_rear: Indices
    group: Indices
    survey_m2: Array
    order: PairOrder
    planes: Array
    log_volume: float
    sigma_focal: float

    def __len__(self) -> int:
        """How many lights."""
        return len(self.layer)

    def count(self, assignment: Indices) -> tuple[int, ...]:
        """How many lights of each layer have a detection in an `assignment` (M,)."""
        return tuple(np.bincount(self.layer[assignment >= 0], minlength=self.n_layers).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class AttitudePrior:
    """The attitude expected: `R_dock_cam` (3, 3); `measured`: by a sensor.

    `info` (3,) 1/rad^2: one over the variance of the tilt toward cam x, of the tilt toward cam y, and of the roll.
    `any_roll`: probability that the roll is any instead, 0 where a sensor has it.
    """

    R_dock_cam: Array
    info: Array
    measured: bool
    any_roll: float = 0.0

    @property
    def roll_rad(self) -> float:
        """1-sigma roll."""
        return float(self.info[2] ** -0.5)

    def rolled(self) -> AttitudePrior:
        """The same tilt with a roll that is open."""
        return replace(self, info=np.array([*self.info[:2], _OPEN_ROLL_RAD**-2]), any_roll=0.0)

    def about(self, R_cam_dock: Array, gate: float) -> AttitudePrior:
        """The prior of an attitude (3, 3): this one, or about its own roll where that is over `gate` sigmas off."""
        D = self.R_dock_cam.T @ R_cam_dock.T
        roll = math.atan2(D[1, 0] - D[0, 1], D[0, 0] + D[1, 1])
        if self.any_roll == 0.0 or abs(roll) <= gate * self.roll_rad:
            return self
        c, s = math.cos(roll), math.sin(roll)
        turned = self.R_dock_cam @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(self.rolled(), R_dock_cam=turned)


def station_model(station: Station, camera: Camera, config: MatchConfig) -> StationModel:
    """Prepare a station and a camera for the estimator."""
    front_first = station.layers_front_to_rear()
    behind = np.array([front_first.index(name) for name in station.layers])  # layers in front of each
    size = np.array([camera.width, camera.height]) / camera.focal_px
    return StationModel(
        lights=Lights(camera.lens(), np.ascontiguousarray(station.p_dock), station.axis),
        layer=station.layer,
        n_layers=len(station.layers),
        is_rear=((behind == len(front_first) - 1) & (behind > 0)).astype(np.int64),  # a lone layer is the front one
        group=_groups(station),
        survey_m2=station.sigma_light_m**2 + (behind > 0)[station.layer] * 2.0 * station.sigma_layer_m**2,
        order=_pair_order(station),
        planes=_planes(station),
        log_volume=math.log(float(size.prod()) * config.far_m**3 / 3.0),
        sigma_focal=station.sigma_focal,
    )


def _groups(station: Station) -> Indices:
    """The subset (M,) that is blind to each light: layer by layer, so that two lights of one seldom share it."""
    group = np.empty(len(station), np.int64)
    group[np.argsort(station.layer, kind="stable")] = np.arange(len(station)) % MAX_SUBSETS
    return group


def _planes(station: Station) -> Array:
    planes = np.full((len(station.layers), 6), np.nan)
    for k, p in enumerate(station.p_dock[station.lights_of(name)] for name in station.layers):
        _, spread, axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)
        if len(spread) < 3 or spread[2] < _FLAT * spread[0]:
            planes[k] = *p.mean(axis=0), *np.cross(axes[0], axes[1])
    return planes


def _pair_order(station: Station) -> PairOrder:
    """All pairs of lights of one layer, those first that leave the fewest lights of a layer without a pair tried."""
    orders = [_spread_order(station.p_dock[lights], lights) for lights in map(station.lights_of, station.layers)]
    done = [0] * len(orders)
    pairs, unseen = [], []

    def left(layer: int) -> int:
        """Most lights of a layer that can be assigned without a pair of those done."""
        return len(orders[layer]) - max(done[layer], 1) + 1

    while any(k < len(order) for order, k in zip(orders, done, strict=True)):
        layer = max((n for n in range(len(orders)) if done[n] < len(orders[n])), key=lambda n: (left(n), -n))
        most = max(map(left, range(len(orders))))
        k = done[layer]
        for earlier in range(k):
            pairs.append((orders[layer][earlier], orders[layer][k]))
            unseen.append(most)
        done[layer] += 1
    rank = np.empty(len(station), np.int64)
    for order in orders:
        rank[order] = np.arange(len(order))
    return PairOrder(rank, np.array(pairs, np.int64).reshape(-1, 2), np.array(unseen, np.int64))


def _spread_order(p: Array, lights: Indices) -> list[int]:
    """Lights in an order that keeps the next one far from those before it."""
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    order = [int(distance.sum(axis=1).argmax())]
    while len(order) < len(p):
        nearest = distance[:, order].min(axis=1)
        nearest[order] = -1.0
        order.append(int(nearest.argmax()))
    return [int(lights[k]) for k in order]


def attitude_prior(attitude: Attitude | None, config: PriorConfig) -> AttitudePrior:
    """The attitude prior: the vehicle's own where it has one, else the configured one about head-on."""
    if attitude is not None:
        return AttitudePrior(np.ascontiguousarray(attitude.R_dock_cam), np.full(3, attitude.sigma_rad**-2), True)
    sigma = np.deg2rad([config.yaw_deg, config.pitch_deg, config.roll_deg])
    return AttitudePrior(_HEAD_ON, sigma**-2, False, config.any_roll)


def measurements(detections: Detections, model: StationModel, config: MatchConfig) -> Measurements:
    """One frame's detections with the weights that evidence, association and filter give them.

    Centroids without a covariance get the configured one. A detection that does not look like a lamp may be more than
    one, or a part of one: its centroid is uncertain by a share of its radius. Clutter is geometric in number about
    `spurious`, a share of it where the detections stand.
    """
    uv, n = np.ascontiguousarray(detections.uv), len(detections)
    if detections.cov_px2 is None:
        cov = np.tile(np.eye(2) * config.noise_px**2, (n, 1, 1))
    else:
        cov = np.array(detections.cov_px2, np.float64, order="C")
    p_light = np.array(detections.p_light, np.float64)
    frame = Measurements(uv, cov, np.empty(n), np.empty((n, model.n_layers)), p_light, 0.0)
    radius_px, p_rear = np.ascontiguousarray(detections.radius_px), np.ascontiguousarray(detections.p_rear)
    appearance = Appearance(config.label_trust, config.unlikely_radii, _MOST_RADIUS_PX, _P_USUAL)
    weigh(radius_px, p_rear, model.is_rear, appearance, frame)
    ignored = p_light < LEAST_P_LIGHT
    frame.like[ignored] = _IMPOSSIBLE
    usual = uv[p_light >= _P_USUAL]
    lens, share = model.lights.lens, config.clutter_near
    whole = lens[6] * lens[7]
    box = min(float(np.ptp(usual, axis=0).prod()) + config.clutter_margin_px**2, whole) if len(usual) else whole
    density = (1.0 - share) / whole + share / box
    log_density = math.log(density * config.spurious / (1.0 + config.spurious))
    return Measurements(uv, cov, frame.var, frame.like, p_light, log_density)


def weights(p_light: Array) -> Array:
    """How much each detection (N,) counts as clutter: one that is rather a lamp than not counts fully."""
    return np.where(p_light < LEAST_P_LIGHT, 0.0, np.minimum(p_light / P_LAMP, 1.0))


def count_lamps(frame: Measurements) -> int:
    """How many detections are rather lamps than not."""
    return int(np.count_nonzero(frame.p_light >= P_LAMP))


def possible_lamps(detections: Detections) -> int:
    """How many detections are not out of the question as lamps."""
    return int(np.count_nonzero(~(detections.p_light < LEAST_P_LIGHT)))


def light_of(assignment: Indices, n: int) -> Indices:
    """The light (N,) of each of `n` detections, or -1, from the detection of each light, `assignment` (M,)."""
    light = np.full(n, -1, np.int64)
    used = np.flatnonzero(assignment >= 0)
    light[assignment[used]] = used
    return light
