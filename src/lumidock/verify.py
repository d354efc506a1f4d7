"""May an association be believed: the innovation test with history, the evidence without."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumidock.config import Config, IntegrityConfig, MatchConfig, TrackConfig
from lumidock.datatypes import Indices
from lumidock.light_counts import CHECKED_LIGHTS, JOINT_TRACK_LIGHTS, POSE_LIGHTS
from lumidock.match import Acquisition, conflicts
from lumidock.track import Track


def innovation_holds(track: Track, config: TrackConfig) -> bool:
    """Whether the last frame's innovation, and that of the frames before, is as large as its covariance allows."""
    small = track.last.deviate < config.max_deviate and track.mean_deviate < config.max_mean_deviate
    return track.last.n_used > 0 and small


def explains(track: Track, lamps: int, config: TrackConfig) -> bool:
    """Whether a track passes its innovation test and leaves no array's worth of a frame's `lamps` unexplained."""
    used = track.last.n_used
    return (used >= POSE_LIGHTS or lamps - used < CHECKED_LIGHTS) and innovation_holds(track, config)


def holds(track: Track, lamps: int, config: TrackConfig) -> bool:
    """Whether a track explains a frame of so many `lamps`, by lights enough.

    Three lights of one plane fit many poses: only a track that has seen two layers lives on less than four.
    """
    least = JOINT_TRACK_LIGHTS if track.estimates_calibration else CHECKED_LIGHTS
    return track.last.n_used >= least and explains(track, lamps, config)


def is_answer(found: Acquisition, config: MatchConfig) -> bool:
    """Whether one frame alone decides its association: four lights or more, and nothing else fits nearly as well."""
    enough = bool(found.hypotheses) and found.hypotheses[0].n_assigned >= CHECKED_LIGHTS
    return enough and found.margin > config.margin


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
    """The margin that one frame gave an association, until no frame agrees with it: then it no longer proves it."""
    return margin if track.agreeing_frames > 0 else min(margin, config.evidence)


def is_proven(track: Track, margin: float, config: IntegrityConfig) -> bool:
    """Whether the association meets the stated risk: by the evidence of one frame, or carried by several in a row.

    One that no single frame could decide (`margin` 0) has to be carried for longer; after a failed test all have to.
    """
    carried = config.carried_frames if margin > 0.0 else config.gathered_frames
    return track.agreeing_frames > 0 and (margin > config.evidence or track.agreeing_frames >= carried)
