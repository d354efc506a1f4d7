"""The acquisition step: new tracks from the hypotheses of one frame, confirmed by it or by those that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lumidock import file_check, match, model, track, verify
from lumidock._kernels.measurements import Measurements
from lumidock.datatypes import Attitude, Contradiction, Indices
from lumidock.light_counts import CHECKED_LIGHTS, POSE_LIGHTS
from lumidock.match import Acquisition, Hypothesis
from lumidock.model import attitude_prior
from lumidock.state import Context, LocalizerState
from lumidock.track import CalibrationStates, Track
from lumidock.tracking import likeliest

_MAX_RIVALS = 16  # contradicting hypotheses that are followed beside an answer


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame to acquire from: its time, its detections, the vehicle's own attitude, and what stays the same."""

    t_ns: int
    frame: Measurements
    attitude: Attitude | None
    context: Context

    def acquire(self, *, all_mirrors: bool = False) -> Acquisition:
        """What the detections can be without history; with `all_mirrors` images in walls and floor are rivals too."""
        config, context = self.context.config, self.context
        prior = attitude_prior(self.attitude, config.prior)
        return match.acquire(self.frame, context.model, context.camera, prior, config.match, all_mirrors=all_mirrors)

    def shows_twin(self, assignment: Indices) -> bool:
        """Whether the detections that an association leaves over are another array of the same layout."""
        if self.context.station.dock_exclusive:
            return False
        frame = match.without(self.frame, assignment)
        if model.count_lamps(frame) < CHECKED_LIGHTS:
            return False
        config, prior = self.context.config, attitude_prior(self.attitude, self.context.config.prior)
        twin = match.acquire(frame, self.context.model, self.context.camera, prior, config.match)
        return verify.is_answer(twin, config.match)

    def displaced_layer(self, one: Track) -> Contradiction | None:
        """What a layer says that is identified by itself although the track has no use for any of its lights."""
        context, left = self.context, match.without(self.frame, one.last.assignment)
        config, prior = context.config.match, attitude_prior(self.attitude, context.config.prior)
        for k, alone in enumerate(context.layer_alone):
            if alone is None or one.last.count[k] or model.count_lamps(left) < CHECKED_LIGHTS:
                continue
            found = match.acquire(left._replace(like=left.like[:, [k]]), alone, context.camera, prior, config)
            if verify.is_answer(found, config):
                return file_check.displaced_layer(one, context.station, k, found.hypotheses[0].T_cam_dock)
        return None

    def start(self, hypothesis: Hypothesis, calibration: CalibrationStates | None) -> Track | None:
        """A new track from a hypothesis and what is known of survey and calibration; None for two lights or fewer."""
        if hypothesis.n_assigned < POSE_LIGHTS:
            return None
        context, config = self.context, self.context.config
        return track.start(
            hypothesis,
            self.frame,
            context.model,
            config.track,
            t_ns=self.t_ns,
            prior=attitude_prior(self.attitude, config.prior).about(hypothesis.R, config.match.roll_gate),
            calibration=calibration or track.calibration_prior(context.station, self.attitude),
        )


def confirm(
    state: LocalizerState, found: Acquisition, moment: Moment, still_held: Sequence[Track]
) -> tuple[LocalizerState, bool]:
    """Follow an answer, its other poses and, with history, what contradicts it and is not yet out of the question.

    A track that still holds against the answer, `still_held`, weighs as much, until the next frames tell. The second
    value is False where the answer fails its test; the state is then as it was, but for the calibration.
    """
    context, head = moment.context, found.hypotheses[0]
    rivals = [h for h in found.hypotheses[1:] if verify.contradict(h.assignment, head.assignment)]
    wanted = [head, *found.other_poses, *([] if context.cold else rivals[:_MAX_RIVALS])]
    calibration = state.calibration
    if state.confirmed and state.first.estimates_calibration:
        calibration = track.learned_calibration(state.first)
    begun = _begin(wanted, moment, calibration)
    if not begun and calibration is not None:  # what an earlier track has learned may be wrong
        begun = _begin(wanted, moment, None)
        calibration = None if begun else calibration
    if not begun:
        return replace(state, calibration=calibration), False
    held = [replace(one, log_weight=head.log_evidence) for one in still_held]
    disputed = any(verify.contradict(one.last.assignment, head.assignment) for one in held)
    confirmed = replace(
        state,
        hypotheses=likeliest([*held, *begun], context),
        confirmed=True,
        margin=context.config.match.margin if disputed else max(found.certainty, context.config.match.margin),
        thin_frames=0,
        calibration=calibration,
    )
    return confirmed, True


def _begin(wanted: Sequence[Hypothesis], moment: Moment, calibration: CalibrationStates | None) -> list[Track]:
    """Tracks from hypotheses; none where the first does not pass its test."""
    first, *rest = [moment.start(hypothesis, calibration) for hypothesis in wanted]
    if first is None or not verify.innovation_holds(first, moment.context.config.track):
        return []
    return [first, *(one for one in rest if one is not None)]


def gather(state: LocalizerState, followed: Sequence[Track], found: Acquisition, moment: Moment) -> LocalizerState:
    """Follow every hypothesis that one frame leaves open until one stands out, in this frame too.

    A hypothesis that this frame gives again starts anew from its pose now, with the weight that it has gathered. The
    state is `confirmed` where one stands out and passes its test.
    """
    context, config = moment.context, moment.context.config
    new = [*found.hypotheses, *found.other_poses][: config.track.hypotheses]
    begun = [_renewed(hypothesis, new, followed, moment, state.calibration) for hypothesis in new]
    others = [one for one in followed if not any((one.last.assignment == h.assignment).all() for h in new)]
    tracks = likeliest([*others, *(one for one in begun if one is not None)], context)
    state = replace(state, hypotheses=tracks)
    if found.reason == "mirror" or not tracks or not verify.stands_out(tracks, found, config):
        return state
    return replace(state, confirmed=verify.innovation_holds(tracks[0], config.track), margin=0.0)


def _renewed(
    hypothesis: Hypothesis,
    new: Sequence[Hypothesis],
    followed: Sequence[Track],
    moment: Moment,
    calibration: CalibrationStates | None,
) -> Track | None:
    """A track from a hypothesis, with what the same assignment has gathered; another pose keeps its distance."""
    assignment = hypothesis.assignment
    begun = moment.start(hypothesis, calibration)
    before = next((one for one in followed if (one.last.assignment == assignment).all()), None)
    if begun is None or before is None:
        return begun or before
    best = max(other.log_evidence for other in new if (other.assignment == assignment).all())
    return replace(
        begun,
        log_weight=before.log_weight + hypothesis.log_evidence - best,
        began_ns=before.began_ns,
        agreeing_frames=before.agreeing_frames,
    )
