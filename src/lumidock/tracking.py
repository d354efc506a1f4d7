"""The tracking step: every hypothesis is predicted to the time of a frame, associated with its detections, updated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lumidock import aiding, track, verify
from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking.track import PredictedMeasurements
from lumidock.aiding import NO_AIDING, AidingState
from lumidock.datatypes import Array, Attitude
from lumidock.light_counts import CHECKED_LIGHTS
from lumidock.model import count_lamps
from lumidock.state import Context, LocalizerState
from lumidock.track import FrameResult, Track


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The hypotheses of a state at `t_ns`, the time of the next frame.

    `tracks`: those that have seen a light lately. `measurements`: where the first of them expects its lights, while it
    is being tracked; None: nothing is expected, and a frame has to be searched in full. `aiding`: what is known of the
    vehicle's sensors then; `deceived`: one of them lied to the tracks, and none of them is left.
    """

    t_ns: int
    tracks: tuple[Track, ...]
    measurements: PredictedMeasurements | None
    aiding: AidingState = NO_AIDING
    deceived: bool = False

    def windows(self) -> Array | None:
        """Where a detector has to look: (n, 3) u, v and reach px; None: everywhere."""
        return None if self.measurements is None else track.search_windows(self.measurements)

    def with_attitude(self, attitude: Attitude | None) -> Prediction:
        """The prediction updated by the vehicle's own attitude, where it has one."""
        if attitude is None:
            return self
        tracks = tuple(track.update_attitude(one, attitude) for one in self.tracks)
        return replace(self, tracks=tracks, measurements=None)


def predict(state: LocalizerState, t_ns: int, context: Context) -> Prediction:
    """The hypotheses at the time of a frame; those without lights for too long, or from the future, are dropped.

    On the way to it they are updated by what the vehicle's sensors have measured since the frame before.
    """
    gap_s = aiding.max_gap_s(state.aiding, state.first.t_ns if state.hypotheses else t_ns, context.config)
    alive = [one for one in state.hypotheses if one.t_ns < t_ns <= one.seen.light_ns + gap_s * 1e9]
    followed = state.confirmed and bool(alive) and alive[0] is state.first
    tracks, sensors, deceived = aiding.advance(
        alive, state.aiding, t_ns, context.model, context.config, confirmed=followed
    )
    if not tracks or not followed or not _is_tracked(state, t_ns):
        return Prediction(t_ns, tracks, None, sensors, deceived)
    return Prediction(t_ns, tracks, track.predict_measurements(tracks[0], context.model), sensors)


def _is_tracked(state: LocalizerState, t_ns: int) -> bool:
    """Whether the first hypothesis held in the last frame, so that the next needs to be searched only where it says."""
    if not state.confirmed or state.failures or state.last is None:
        return False
    return state.last.t_ns <= state.first.t_ns < t_ns


def is_frozen(state: LocalizerState, predicted: Prediction, frame: Measurements, context: Context) -> bool:
    """Whether the frame is the picture before again, though the confirmed track moves or that one was frozen too."""
    before = state.last
    if before is None or not verify.repeats(frame, before.uv):
        return False
    if state.frozen:
        return True
    if not (state.confirmed and predicted.tracks):
        return False
    one = predicted.tracks[0]
    if one.last.n_used == 0 or one.last.assignment.max() >= len(before):
        return False
    expected = predicted.measurements or track.predict_measurements(one, context.model)
    return verify.moves(one, expected, before.uv, math.sqrt(float(frame.var.mean())))


def follow(predicted: Prediction, frame: Measurements, context: Context, *, confirmed: bool) -> tuple[Track, ...]:
    """The hypotheses that find lights in this frame, updated by these, the likeliest first.

    One whose pose does not settle cannot be judged, and the others must not win for want of it: it is kept as it was
    predicted. A confirmed track follows none that is first.
    """
    model, config = context.model, context.config
    followed: list[Track] = []
    unjudged: list[Track] = []
    for k, one in enumerate(predicted.tracks):
        expected = predicted.measurements if k == 0 else None
        found = track.associate(one, frame, model, config, expected)
        if found.log_evidence == -math.inf:
            return ()
        if not (found.assignment >= 0).any():
            continue
        updated = track.update(one, found.assignment, frame, model, config.track, log_evidence=found.log_evidence)
        if updated is None:
            result = replace(one.last, assignment=found.assignment, count=model.count(found.assignment))
            unjudged.append(replace(one, log_weight=one.log_weight + found.log_evidence, last=result))
        else:
            followed.append(updated)
    kept = likeliest([*followed, *unjudged], context)
    return () if confirmed and kept and kept[0] in unjudged else kept


def likeliest(tracks: Sequence[Track], context: Context) -> tuple[Track, ...]:
    """The likeliest first, without those that are out of the question or the same as a likelier one."""
    config = context.config.track
    ordered = sorted(tracks, key=lambda one: -one.log_weight)
    kept: list[Track] = []
    for one in ordered[: config.hypotheses]:
        far_behind = one.log_weight < ordered[0].log_weight - config.forget
        if not far_behind and not any(track.same(one, other) for other in kept):
            kept.append(one)
    return tuple(kept)


def overlooks(one: Track, frame: Measurements, context: Context) -> bool:
    """Whether a second layer may be in view where the tilt was too open, or too wrong, to expect it there."""
    model = context.model
    if model.n_layers == 1 or count_lamps(frame) - one.last.n_used < CHECKED_LIGHTS:
        return False
    lately = np.array(one.seen.layer_ns) > one.t_ns - context.config.track.max_gap_s * 1e9
    unseen = np.array(one.last.count) == 0
    return not one.estimates_calibration or bool((lately & unseen).any())


def coast(tracks: Sequence[Track], context: Context, *, failed: bool) -> tuple[Track, ...]:
    """The predicted tracks of a frame in which no light fits; after a `failed` test no frame before it counts."""
    nothing = FrameResult.nothing(context.model)
    return tuple(
        replace(
            one,
            last=replace(one.last, assignment=nothing.assignment, count=nothing.count),
            agreeing_frames=0 if failed else one.agreeing_frames,
        )
        for one in tracks
    )
