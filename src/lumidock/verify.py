"""May an association be believed: the innovation test with history, the evidence without."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking.track import TWIST, PredictedMeasurements
from lumidock.config import Config, IntegrityConfig, MatchConfig, TrackConfig
from lumidock.datatypes import Array, Indices
from lumidock.light_counts import CHECKED_LIGHTS, JOINT_TRACK_LIGHTS, POSE_LIGHTS
from lumidock.match import Acquisition, alike, conflicts
from lumidock.track import Track

_REPEATED_SHARE = 0.7  # of the detections that must repeat
_REPEATED_SIGMAS = 0.15  # rms difference a coordinate of a repeated detection; that of independent noise is sqrt(2)
_MOVES_M_S, _MOVES_RAD_S = 0.1, 0.02  # faster is not hovering
_MOVED_SIGMAS = 0.3  # rms a coordinate that the lights are expected to have moved: twice what counts as a repetition


def innovation_holds(track: Track, config: TrackConfig) -> bool:
    """Whether the last frame's innovation, and that of the frames before, is as large as its covariance allows."""
    small = track.last.deviate < config.max_deviate and track.mean_deviate < config.max_mean_deviate
    return track.last.n_used > 0 and small


def explains(track: Track, lamps: int, config: TrackConfig) -> bool:
    """Whether a track passes its innovation test, and uses three lights or leaves under four `lamps` unassigned."""
    used = track.last.n_used
    return (used >= POSE_LIGHTS or lamps - used < CHECKED_LIGHTS) and innovation_holds(track, config)


def holds(track: Track, lamps: int, config: TrackConfig) -> bool:
    """Whether a track explains a frame of so many `lamps`, by lights enough.

    Three lights of one plane fit many poses. Only a track that estimates its calibration states, which it begins when
    it first sees two layers together, needs fewer than four.
    """
    least = JOINT_TRACK_LIGHTS if track.estimates_calibration else CHECKED_LIGHTS
    return track.last.n_used >= least and explains(track, lamps, config)


def is_answer(found: Acquisition, config: MatchConfig) -> bool:
    """Whether one frame alone decides its association: four lights or more, and nothing else fits nearly as well."""
    enough = bool(found.hypotheses) and found.hypotheses[0].n_assigned >= CHECKED_LIGHTS
    return enough and found.margin > config.margin


def finds_array(found: Acquisition, assignment: Indices, config: MatchConfig) -> bool:
    """Whether an acquisition finds the array where an association has it, one light assigned otherwise at most."""
    return is_answer(found, config) and bool(alike(found.hypotheses[0].assignment, assignment[None])[0])


def agrees(found: Acquisition, assignment: Indices, config: MatchConfig) -> bool:
    """Whether an acquisition gives four lights the same detections as an association, and none another."""
    if not is_answer(found, config):
        return False
    fresh = found.hypotheses[0].assignment
    same = int(((fresh == assignment) & (fresh >= 0)).sum())
    return same >= CHECKED_LIGHTS and not contradict(fresh, assignment)


def repeats(frame: Measurements, before: Array, *, least: int) -> bool:
    """Whether a picture is the one `before` again, of centroids (N, 2) px, by so many of them at `least`.

    Noise never repeats: most centroids within a fraction of their sigma come from a camera or decoder that hangs.
    """
    least = max(least, math.ceil(_REPEATED_SHARE * len(frame.uv)))
    if len(before) == 0 or len(frame.uv) < least:
        return False
    apart = np.linalg.norm(frame.uv[:, None] - before[None], axis=2).min(axis=1) / np.sqrt(frame.var)
    nearest = np.sort(apart)[:least]
    return math.sqrt(0.5 * float((nearest**2).mean())) < _REPEATED_SIGMAS


def moves(track: Track, expected: PredictedMeasurements, before: Array, sigma_px: float) -> bool:
    """Whether a track is not hovering and expects its lights elsewhere in the image than the frame `before` had them.

    The track was updated by that frame, of centroids (N, 2) px and noise `sigma_px`; `expected` is where they are now.
    """
    twist, used = track.state.x[TWIST : TWIST + 6], np.flatnonzero(track.last.assignment >= 0)
    if np.linalg.norm(twist[:3]) < _MOVES_M_S and np.linalg.norm(twist[3:]) < _MOVES_RAD_S:
        return False
    moved = expected.uv[used] - before[track.last.assignment[used]]
    return math.sqrt(float((moved**2).mean())) > _MOVED_SIGMAS * sigma_px


def stands_out(tracks: Sequence[Track], found: Acquisition, config: Config) -> bool:
    """Whether the first of several hypotheses followed over frames has left all others, and clutter, far behind.

    And is, in this frame on its own, likelier than all that contradict it.
    """
    first = tracks[0]
    assignment = first.last.assignment
    if first.t_ns == first.began_ns or first.last.n_used < POSE_LIGHTS:
        return False
    own = [h.log_evidence for h in found.hypotheses if (h.assignment == assignment).all()]
    now = [h.log_evidence for h in found.hypotheses if contradict(assignment, h.assignment)]
    if not own or (now and max(own) - max(now) < config.match.lead):
        return False
    rivals = [other.log_weight for other in tracks[1:] if contradict(assignment, other.last.assignment)]
    against = float(np.logaddexp.reduce([-config.match.log_dock, *rivals]))
    return first.log_weight - against > config.match.margin_gathered


def contradict(a: Indices, b: Indices) -> bool:
    """Whether two assignments (M,) give a light two detections, or a detection two lights."""
    return bool(conflicts(a, b[None])[0])


def remaining_margin(track: Track, margin: float, config: IntegrityConfig) -> float:
    """The margin of a track; where no frame agrees since a failed test another frame has to prove it again."""
    return margin if track.agreeing_frames > 0 else min(margin, -math.log(config.risk))


def is_proven(track: Track, margin: float, config: IntegrityConfig) -> bool:
    """Whether the association meets the stated risk: by the evidence of one frame, and no failed test since.

    Frames that only repeat an association prove nothing: a glint on the structure repeats as well as a lamp.
    """
    return track.agreeing_frames > 0 and margin > -math.log(config.risk)
