"""May a match be believed: the innovation test with history, the evidence without."""

from __future__ import annotations

import numpy as np

from lumidock.config import Config, IntegrityConfig, MatchConfig, TrackConfig
from lumidock.datatypes import Indices
from lumidock.match import Acquisition, conflicts
from lumidock.track import Track

_MIN_LOCK, _MIN_GATHERED = 4, 3


def innovation_holds(track: Track, config: TrackConfig) -> bool:
    """Whether the last frame's innovation, and that of the frames before, is as large as its covariance allows."""
    return track.n_used > 0 and track.surprise < config.max_deviate and track.strain < config.max_mean_deviate


def is_answer(found: Acquisition, config: MatchConfig) -> bool:
    """Whether one frame alone names its lights: four or more of them, and nothing else fits nearly as well."""
    return bool(found.candidates) and _named(found.candidates[0].name) >= _MIN_LOCK and found.margin > config.margin


def names_of(found: Acquisition, config: MatchConfig, lights: int) -> Indices:
    """The names (M,) of an answer, none where there is no answer."""
    return found.candidates[0].name if is_answer(found, config) else np.full(lights, -1, np.int64)


def gathered(beliefs: list[Track], found: Acquisition, config: Config) -> bool:
    """Whether the first of several namings followed over frames has left all others, and clutter, far behind.

    And is, in this frame on its own, likelier than all that contradict it.
    """
    first = beliefs[0]
    if first.t_ns == first.began_ns or first.n_used < _MIN_GATHERED:
        return False
    own = [c.log_evidence for c in found.candidates if (c.name == first.name).all()]
    now = [c.log_evidence for c in found.candidates if contradict(first.name, c.name)]
    if not own or (now and max(own) - max(now) < config.match.lead):
        return False
    rivals = [b.log_weight for b in beliefs[1:] if contradict(first.name, b.name)]
    against = float(np.logaddexp.reduce([-config.match.log_dock, *rivals]))
    return first.log_weight - against > config.match.margin_gathered


def contradict(a: Indices, b: Indices) -> bool:
    """Whether two namings (M,) give a light two detections, or a detection two lights."""
    return bool(conflicts(a, b[None])[0])


def is_proven(track: Track, margin: float, config: IntegrityConfig) -> bool:
    """Whether the names meet the stated risk: by the evidence of one frame, or carried by several in a row.

    Names that no single frame could decide (`margin` 0) have to be carried for longer; after a failed test all have to.
    """
    carried = config.carried_frames if margin > 0.0 else config.gathered_frames
    return track.proof > 0 and (margin > config.evidence or track.proof >= carried)


def _named(name: Indices) -> int:
    return int((name >= 0).sum())
