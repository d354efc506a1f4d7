"""Acquisition: which detection is which light without history, over all layers at once, and what else it could be.

**The decision.** `log_evidence(A)` of an association A, in `_kernels.evidence`, is its log evidence over "all
detections are clutter", with the pose integrated out. Of the best association A1, all of whose poses share `best`, and
of everything that speaks against it,

    best      = max over the poses of A1 of log_evidence
    against   = log( exp(-log_dock)                              no dock in view: all detections are clutter
                   + exp(mirror)                                 the water's surface shows the array
                   + sum over kept lights c of exp(against_c)    relabellings of one light of A1
                   + sum over A in `conflicting` of exp(log_evidence(A)) )
    margin    = best - against                                   log odds of the assignment
    odds_c    = best - log( exp(without_c + crowding) + ... )    log odds of one light's detection

`mirror` holds the prior `log_mirror`; `crowding` is by how much, as a logarithm, unassigned detections stand denser
around the assigned ones than the evidence's clutter has it. Lights of too small `odds_c` are dropped (`kept`).

    certainty = log odds that the array is where A1 has it: as the margin, but for the associations that differ from A1
                in one light only and share three others, whose pose is about the same, and less the crowding; no more
                than the configured margin where fewer than four lights are each beyond doubt in this sense

An answer has four lights and a margin over the configured one (`verify.is_answer`). That one light is assigned wrongly
is left to the protection levels; `certainty` is what an association is proven by (`verify.is_proven`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lumidock._kernels.matching.evidence import HUGE, Candidate, Problem, SearchRules
from lumidock._kernels.matching.rivals import Doubt, other_pose, rivals
from lumidock._kernels.matching.search import Goal, Hypotheses, search
from lumidock._kernels.measurements import Measurements
from lumidock.camera import Camera
from lumidock.config import MatchConfig
from lumidock.datatypes import Array, Indices
from lumidock.light_counts import CHECKED_LIGHTS, LAYER_LIGHTS, POSE_LIGHTS
from lumidock.model import LEAST_P_LIGHT, P_LAMP, AttitudePrior, StationModel, light_of, weights

_LEVEL, _UPRIGHT = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])  # images in surface or floor; in a wall
_NONE = -HUGE  # log evidence of what is impossible
_MAX_RELABELLINGS = 4  # each betters the evidence; more than two have not been seen
_OPEN_ROLL_RAD = math.radians(45.0)  # 1 sigma; of a roll less known than this a steady vehicle says nothing
_ANY_COSINE = 2.0  # of a roll that nothing bounds; so is its negative
_FEW = 10  # detections, among which four lights at any roll are searched for in a few ms
_SPARE = 2  # lights of the best that a turned array may do without: they may be clutter that fits by chance
_AROUND = 0.25  # of the width of the assigned detections: how far around them others crowd


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """The detection of each light or -1, `assignment` (M,), T_cam_dock `R`, `t` that fits it, its log evidence."""

    assignment: Indices
    R: Array
    t: Array
    log_evidence: float

    @property
    def T_cam_dock(self) -> Array:
        """Pose (4, 4) of the dock in `cam`."""
        T_cam_dock = np.eye(4)
        T_cam_dock[:3, :3], T_cam_dock[:3, 3] = self.R, self.t
        return T_cam_dock

    @property
    def n_assigned(self) -> int:
        """How many lights have a detection."""
        return int((self.assignment >= 0).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """What one frame's detections can be; the symbols are those of the module's decision.

    `hypotheses`: the best first, without its doubtful lights, then all others that fit, with theirs. `other_poses`: the
    best assignment with the other poses that it fits, where a plane leaves two. `reason`: why it is no answer.
    """

    hypotheses: tuple[Hypothesis, ...]
    other_poses: tuple[Hypothesis, ...]
    margin: float
    reason: str = ""
    certainty: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """One frame's acquisition problem as the kernels take it, with what bounds the search."""

    problem: Problem
    model: StationModel
    config: MatchConfig

    @property
    def expects_roll(self) -> bool:
        """Whether it is about the expected roll, rather than about any other."""
        return self.problem.rules.roll_cosines[0] == _ANY_COSINE

    def mirrored(self, by: Array) -> Problem:
        """The problem with the lights as a mirror shows them that turns the axes of the dock `by` (3,)."""
        return self.problem._replace(p=self.problem.p * by, axis=self.problem.axis * by)


def acquire(
    frame: Measurements,
    model: StationModel,
    camera: Camera,
    prior: AttitudePrior,
    config: MatchConfig,
    *,
    all_mirrors: bool = False,
) -> Acquisition:
    """The most probable association of one frame's detections, and what it must be held against.

    Of many detections those that look least like lamps stay out. With `all_mirrors` walls and floor are rivals too,
    besides the water's surface.
    """
    likely = _likeliest(frame, max(config.least_detections, config.detections_per_light * len(model)))
    if likely is not None:
        part = _part(frame, likely)
        return _renumbered(acquire(part, model, camera, prior, config, all_mirrors=all_mirrors), likely)
    task = _Search(_problem(frame, model, camera, prior, config), model, config)
    found, complete = _search(task, task.problem, POSE_LIGHTS, CHECKED_LIGHTS, POSE_LIGHTS)
    tasks = [task]
    if complete and prior.any_roll > 0.0 and config.roll_gate * prior.roll_rad < math.pi:
        rolled = _Search(_rolled(task.problem, prior), model, config)
        more, complete = _rivals_of_any_roll(rolled, found)
        better = len(more.log_evidence) and more.log_evidence[0] > found.log_evidence.max(initial=_NONE)
        tasks, found = [rolled, task] if better else [task, rolled], _merged(found, more)
    if not complete:
        return Acquisition((), (), 0.0, "too_many")
    if not len(found.log_evidence):
        return Acquisition((), (), 0.0, "too_few" if len(frame.uv) < POSE_LIGHTS else "ambiguous")
    first = Hypothesis(found.assignments[0], found.R[0], found.t[0], float(found.log_evidence[0]))
    top, doubt = _relabelled(tasks[0], first)
    asked = tasks if not tasks[0].expects_roll else tasks[:1]  # the prior of a rolled mirror image excludes it
    mirrors = [_mirror_evidence(one, top, all_mirrors=all_mirrors) for one in asked]
    if None in mirrors:
        return Acquisition((), (), 0.0, "too_many")
    return _decided(tasks[0], frame, found, top, doubt, float(np.logaddexp.reduce(np.array(mirrors, float))))


def _rivals_of_any_roll(task: _Search, found: Hypotheses) -> tuple[Hypotheses, bool]:
    """Hypotheses of any roll that may stand against the best found so far; and whether the search came to its end.

    Their prior is as small as a light is worth: with fewer lights than the best, or of one layer, they are out of the
    question. Where the best may be an answer, its own detections tell first whether the array fits them turned, too.
    """
    config, best = task.config, float(found.log_evidence.max(initial=_NONE))
    if best + config.log_dock <= config.margin:
        least = CHECKED_LIGHTS + int(len(task.problem.uv) > _FEW)
        return _search(task, task.problem, least, least, best=best)
    count = task.model.count(found.assignments[0])
    used = np.sort(found.assignments[0][found.assignments[0] >= 0])
    least, of_a_layer = (max(n - _SPARE, CHECKED_LIGHTS) for n in (sum(count), max(count)))
    turned, complete = _search(task, _only(task.problem, used), least, of_a_layer, best=best)
    if not complete or (turned.log_evidence <= best - config.keep).all():
        return _cut(turned, np.empty(0, np.int64)), complete
    turned.assignments[:] = np.where(turned.assignments >= 0, used[turned.assignments], -1)
    least, of_a_layer = (max(n, CHECKED_LIGHTS) for n in (sum(count), max(count)))
    more, complete = _search(task, task.problem, least, of_a_layer, best=best)
    return _merged(more, turned), complete


def _only(problem: Problem, used: Indices) -> Problem:
    """The same problem with some of its detections (K,) alone; the others stay clutter."""
    uv = problem.uv[used]
    by_u: Indices = np.argsort(uv[:, 0])
    return problem._replace(uv=uv, by_u=by_u, ray=problem.ray[used], var=problem.var[used], like=problem.like[used])


def _counted(assignment: Indices, model: StationModel) -> tuple[int, int]:
    """How many lights have a detection, and how many of the layer that has most."""
    count = model.count(assignment)
    return sum(count), max(count)


def _merged(a: Hypotheses, b: Hypotheses) -> Hypotheses:
    """Two lists of hypotheses as one, the best first, without those of the second that are in the first."""
    b = _cut(b, np.flatnonzero(~(b.assignments[:, None] == a.assignments[None]).all(axis=2).any(axis=1)))
    together = Hypotheses(
        np.concatenate([a.assignments, b.assignments]),
        np.concatenate([a.log_evidence, b.log_evidence]),
        np.concatenate([a.R, b.R]),
        np.concatenate([a.t, b.t]),
    )
    best_first: Indices = np.argsort(-together.log_evidence, kind="stable")
    return _cut(together, best_first)


def _cut(found: Hypotheses, which: Indices) -> Hypotheses:
    """Some hypotheses (K,) of a list."""
    assignments, scores, R, t = found
    return Hypotheses(assignments[which], scores[which], R[which], t[which])


def _rolled(problem: Problem, prior: AttitudePrior) -> Problem:
    """The same problem for a vehicle of any roll beyond that of the prior, its probability included."""
    beyond = (problem.rules.roll_cosines[1], -_ANY_COSINE)
    rules = problem.rules._replace(roll_cosines=beyond, log_prior=math.log(prior.any_roll))
    info = prior.rolled().info
    return problem._replace(info=info, steady=np.array([*problem.steady[:2], info[2]]), rules=rules)


def _decided(
    task: _Search, frame: Measurements, found: Hypotheses, top: Hypothesis, doubt: Doubt, mirror: float
) -> Acquisition:
    """The decision of the module's docstring on the hypotheses `found` and the best, `top`."""
    config, scores = task.config, found.log_evidence
    poses = [pose for pose in (_other_pose(task, top, level=level) for level in (False, True)) if pose is not None]
    best = max([top.log_evidence, *(pose.log_evidence for pose in poses)])  # they share most of their mass
    unassigned, crowding = _crowding(top.assignment, frame, task)
    odds = _odds(top, best, found, doubt, crowding)
    kept = _kept(top.assignment, odds, task)
    conflicting = scores[conflicts(kept, found.assignments)]
    against = float(np.logaddexp.reduce([-config.log_dock, mirror, *doubt.against[kept >= 0], *conflicting]))
    margin = best - against
    elsewhere = _cut(found, np.flatnonzero(~alike(kept, found.assignments)))
    rivals_elsewhere = elsewhere.log_evidence[conflicts(kept, elsewhere.assignments)]
    certainty = best - float(np.logaddexp.reduce([-config.log_dock, mirror, *rivals_elsewhere]))
    unlabelled = doubt._replace(against=np.full(len(kept), _NONE))
    certain = _odds(top, best, elsewhere, unlabelled, crowding)[kept >= 0] > config.margin_gathered
    direct = float(np.logaddexp.reduce([_NONE, *scores[(found.assignments != top.assignment).any(axis=1)]]))
    return Acquisition(
        hypotheses=(replace(top, assignment=kept), *_rest(found, kept, best - config.keep)),
        other_poses=tuple(replace(pose, assignment=kept) for pose in poses),
        margin=margin,
        reason=_why_open(best - config.margin, mirror, direct),
        certainty=min(
            certainty - crowding * min(unassigned, 1.0), math.inf if certain.sum() >= CHECKED_LIGHTS else config.margin
        ),
    )


def _why_open(close: float, mirror: float, direct: float) -> str:
    """The word for an association that does not stand out: what comes `close` to its log evidence, if anything."""
    if max(mirror, direct) <= close:
        return "unproven"
    return "mirror" if mirror > direct else "ambiguous"


def _rest(found: Hypotheses, kept: Indices, least: float) -> list[Hypothesis]:
    """The hypotheses over a `least` log evidence whose assignment is not the one `kept`."""
    rows = zip(found.assignments, found.R, found.t, found.log_evidence, strict=True)
    return [Hypothesis(a, R, t, float(e)) for a, R, t, e in rows if e > least and (a != kept).any()]


def without(frame: Measurements, assignment: Indices) -> Measurements:
    """A frame without the detections of an assignment (M,)."""
    left = np.ones(len(frame.uv), bool)
    left[assignment[assignment >= 0]] = False
    return _part(frame, np.flatnonzero(left))


def _part(frame: Measurements, which: Indices) -> Measurements:
    """Some detections (K,) of a frame."""
    uv, cov, var, like, p_light, log_density = frame
    return Measurements(uv[which], cov[which], var[which], like[which], p_light[which], log_density)


def _likeliest(frame: Measurements, most: int) -> Indices | None:
    """The detections (K,) that look most like lamps, `most` and those on a par; None where that leaves none out.

    Where too many are on a par, they stay only if they are rather lamps than not.
    """
    p_light, likely = frame.p_light, frame.p_light >= LEAST_P_LIGHT
    if len(p_light) > most:
        least = float(np.partition(p_light, -most)[-most])
        likely &= p_light >= least
        if likely.sum() > most and least < P_LAMP:
            likely &= p_light > least
    return None if likely.all() else np.flatnonzero(likely)


def _renumbered(found: Acquisition, detections: Indices) -> Acquisition:
    """An acquisition among some `detections` (K,), in the numbers of all."""

    def of_all(part: Hypothesis) -> Hypothesis:
        return replace(part, assignment=np.where(part.assignment >= 0, detections[part.assignment], -1))

    return replace(
        found, hypotheses=tuple(map(of_all, found.hypotheses)), other_poses=tuple(map(of_all, found.other_poses))
    )


def _problem(
    frame: Measurements, model: StationModel, camera: Camera, prior: AttitudePrior, config: MatchConfig
) -> Problem:
    """The acquisition of a frame; the calibration's error of focal length adds to each centroid's."""
    lens, p, axis = model.lights
    offset = (frame.uv - lens[3:5]) * (0.5 * model.sigma_focal)
    var = frame.var + (offset**2).sum(axis=1)
    by_u: Indices = np.argsort(frame.uv[:, 0])
    steady = prior.info * config.steadier**2
    if prior.roll_rad > _OPEN_ROLL_RAD:
        steady[2] = prior.info[2]
    return Problem(
        lens=lens,
        p=p,
        layer=model.layer,
        axis=axis,
        survey_m2=model.survey_m2,
        rank=model.order.rank,
        uv=frame.uv,
        by_u=by_u,
        ray=camera.unproject(frame.uv),
        var=var,
        loosest=float(var.max(initial=0.0)),
        like=frame.like,
        log_clutter=_log_clutter(frame),
        Rp=prior.R_dock_cam,
        info=prior.info,
        steady=steady,
        rules=_rules(model, prior, config),
        work=np.zeros(1, np.int64),
    )


def _rules(model: StationModel, prior: AttitudePrior, config: MatchConfig) -> SearchRules:
    tilt_var, roll_rad = float(1.0 / prior.info[:2].min()), prior.roll_rad
    gated = config.roll_gate * roll_rad < math.pi
    return SearchRules(
        log_volume=model.log_volume,
        detect=config.detect,
        absent=config.layer_absent,
        gate=config.gate,
        pair_gate=config.pair_gate,
        near_m=config.near_m,
        far_m=config.far_m,
        roll_cosines=(_ANY_COSINE, math.cos(config.roll_gate * roll_rad) if gated else -_ANY_COSINE),
        bend=(config.bend * tilt_var) ** 2,
        steady=0.0 if prior.measured else config.steady,
        log_prior=math.log1p(-prior.any_roll),
    )


def _log_clutter(frame: Measurements) -> Array:
    """Log price (N + 1,) of assigning 0, 1, .. N detections instead of calling them clutter.

    A detection counts by what it looks like; that of a lamp counts fully.
    """
    left = weights(frame.p_light).sum() - np.arange(len(frame.uv))
    return np.concatenate([[0.0], np.cumsum(frame.log_density + np.log(np.maximum(left, 1.0)))])


def _search(task: _Search, problem: Problem, floor: int, *leasts: int, best: float = _NONE) -> tuple[Hypotheses, bool]:
    """Hypotheses of at least `floor` lights, best first, by searches that want ever fewer of one layer.

    A later search runs only where the one before left doubt and the detections are few. `best` is a log evidence to
    measure up to. The second value says whether the search came to its end, within the work that a frame may take.
    """
    k, m, count = task.config.hypotheses, len(problem.p), 0
    found = Hypotheses(np.empty((k, m), np.int64), np.empty(k), np.empty((k, 3, 3)), np.empty((k, 3)))
    order, most_work = task.model.order, task.config.max_work
    for least in leasts:
        bounds = np.array([least, floor, floor, 0, 0])
        reached = max(best, found.log_evidence[:count].max(initial=_NONE))
        goal = Goal(bounds, most_work, np.array([reached]))
        count = search(problem, order.pairs, order.unseen, goal, count, found)
        sure = max(best, found.log_evidence[:count].max(initial=_NONE)) > task.config.sure
        if sure or len(task.problem.uv) > task.config.max_detections_three:
            break
    best_first = np.argsort(-found.log_evidence[:count], kind="stable")
    return _cut(found, best_first), int(problem.work[0]) <= most_work


def _relabelled(task: _Search, top: Hypothesis) -> tuple[Hypothesis, Doubt]:
    """Follow the best relabelling as long as it is better; what then speaks against each light."""
    m = len(top.assignment)
    doubt = Doubt(np.empty(m), np.empty(m))
    for _ in range(_MAX_RELABELLINGS):
        doubt = Doubt(np.empty(m), np.empty(m))
        better, taken = _empty(m), light_of(top.assignment, len(task.problem.uv))
        best = rivals(Candidate(top.assignment, top.R, top.t), taken, task.problem, doubt, better)
        if best <= top.log_evidence:
            break
        top = Hypothesis(*better, best)
    return top, doubt


def _empty(m: int) -> Candidate:
    """Room for a hypothesis of `m` lights."""
    return Candidate(np.empty(m, np.int64), np.empty((3, 3)), np.empty(3))


def _other_pose(task: _Search, top: Hypothesis, *, level: bool) -> Hypothesis | None:
    """The best assignment with another pose, if there is one nearly as good."""
    other = _empty(len(top.assignment))
    score = float(other_pose(Candidate(top.assignment, top.R, top.t), task.problem, level, other))
    return Hypothesis(*other, score) if score > top.log_evidence - task.config.keep else None


def _odds(top: Hypothesis, best: float, found: Hypotheses, doubt: Doubt, crowding: float) -> Array:
    """Log odds (M,) of each light's detection against all that leave it out or assign the light otherwise."""
    elsewhere = np.where(found.assignments != top.assignment, found.log_evidence[:, None], _NONE)
    # most relabellings are among the hypotheses as well: counted once
    otherwise = np.maximum(doubt.against, np.logaddexp.reduce(elsewhere))
    return np.where(top.assignment >= 0, best - np.logaddexp(doubt.without + crowding, otherwise), _NONE)


def _kept(assignment: Indices, odds: Array, task: _Search) -> Indices:
    """The assignment (M,) without what is not beyond doubt: single lights, and layers with too few of them.

    The lights beyond doubt stay; where they are fewer than four, the likeliest of the others fill up.
    """
    config, layer = task.config, task.model.layer
    likeliest = np.sort(odds)[::-1]
    least = max(min(config.extra, float(likeliest[min(CHECKED_LIGHTS, len(odds)) - 1])), config.prune)
    kept = np.where(odds >= least, assignment, -1)
    count = np.bincount(layer[kept >= 0], minlength=task.model.n_layers)
    weak = (count < LAYER_LIGHTS) & (count < count.max())
    return np.where(weak[layer], -1, kept)


def _crowding(assignment: Indices, frame: Measurements, task: _Search) -> tuple[float, float]:
    """How many unassigned detections stand around the assigned ones, and how much denser, as a logarithm >= 0, ...

    ... they stand there than the evidence has it. Each counts by how much it looks like a lamp.
    """
    used, lens = frame.uv[assignment[assignment >= 0]], task.model.lights.lens
    low, high = used.min(axis=0), used.max(axis=0)
    low, high = low - _AROUND * (high - low), high + _AROUND * (high - low)
    near = ((frame.uv >= low) & (frame.uv <= high)).all(axis=1)
    near[assignment[assignment >= 0]] = False
    unassigned = float(weights(frame.p_light)[near].sum())
    local = (unassigned + 0.5) / (float((high - low).prod()) + 1.0)
    return unassigned, max(0.0, math.log(local * lens[6] * lens[7] / task.config.spurious))


def _mirror_evidence(task: _Search, top: Hypothesis, *, all_mirrors: bool) -> float | None:
    """Log evidence, prior included, that a mirror shows the array.

    The water's surface does only where the image stands above the camera; a floor or a wall may do so anywhere. None
    where the search does not come to its end.
    """
    total, (n, of_a_layer) = _NONE, _counted(top.assignment, task.model)
    least = min(n, CHECKED_LIGHTS) if task.expects_roll else max(of_a_layer, CHECKED_LIGHTS)
    for mirror in (_LEVEL, _UPRIGHT) if all_mirrors else (_LEVEL,):
        found, complete = _search(task, task.mirrored(mirror), n, least, best=top.log_evidence)
        if not complete:
            return None
        possible = _may_be_in_surface(found, task, mirror) | all_mirrors
        total = float(np.logaddexp.reduce([total, *found.log_evidence[possible]]))
    return total + task.config.log_mirror


def alike(assignment: Indices, others: Indices) -> np.ndarray:
    """Which of `others` (K, M) share three lights with `assignment` (M,) and assign one light otherwise at most.

    The pose of three lights is about the same in both; a single wrong light is covered by the protection levels.
    """
    both = (assignment >= 0) & (others >= 0)
    shared = (both & (assignment == others)).sum(axis=1)
    other = (both & (assignment != others)).sum(axis=1)
    return np.asarray((shared >= POSE_LIGHTS) & (other <= 1))


def _may_be_in_surface(found: Hypotheses, task: _Search, mirror: Array) -> np.ndarray:
    """Whether each of some mirror images may stand above the surface, and so above the camera (K,).

    Its centre has to; and all of its lights, where the vehicle's tilt is known well enough to tell.
    """
    camera_y = -np.einsum("ki,ki->k", found.R[:, :, 1], found.t)
    tilt_rad = 1.0 / math.sqrt(float(task.problem.info[:2].min()))
    open_m = task.config.roll_gate * tilt_rad * np.linalg.norm(found.t, axis=1)
    lowest = float((task.problem.p * mirror)[:, 1].min())
    return np.asarray((camera_y < 0.0) & (camera_y - open_m < lowest))


def conflicts(assignment: Indices, others: Indices) -> np.ndarray:
    """Which of `others` (K, M) give a light of `assignment` (M,) another detection, or a detection another light."""
    both = (assignment >= 0) & (others >= 0)
    light = np.full(max(int(assignment.max(initial=-1)), int(others.max(initial=-1))) + 2, -1)  # the last: none
    light[assignment[assignment >= 0]] = np.flatnonzero(assignment >= 0)
    theirs = light[others]
    claimed = (others >= 0) & (theirs >= 0) & (theirs != np.arange(len(assignment)))
    return np.asarray((both & (assignment != others) | claimed).any(axis=1))
