"""The default method: one frame, from pixels or detections, to a fix. The only object of it with memory."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lumidock import detect, integrity, layers, match, track, verify
from lumidock._kernels.tracking.track import Foreseen
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Fix, Frame, Match, Stage, Status
from lumidock.errors import FrameError, InputError
from lumidock.match import Acquisition, Hypothesis, Spots
from lumidock.station import Station
from lumidock.track import Track

_MIN_LIGHTS, _MIN_SOLID, _MAX_LIGHTS, _MAX_SPOTS, _MAX_RIVALS = 3, 4, 128, 200, 8


class _Ahead(NamedTuple):
    """A belief `moved` to the time of the next frame, and the `view` that it expects there."""

    belief: Track
    moved: Track
    view: Foreseen


class Localizer:
    """Frames or detections in, one fix each out; remembers the frames before unless `cold`.

    `beliefs` are the poses that it holds possible, the likeliest first; before a lock they differ in names.
    """

    def __init__(self, station: Station, camera: Camera, config: Config | None = None, *, cold: bool = False) -> None:
        """Raises: InputError for a station with more lights than the filter can carry."""
        if len(station) > _MAX_LIGHTS:
            raise InputError(f"{station.name}: {len(station)} lights; wanted at most {_MAX_LIGHTS}")
        self.station, self.camera, self.cold = station, camera, cold
        self.config = config or Config()
        self._plan = match.plan(station, camera, self.config.match)
        self.scan: detect.Scan | None = None
        self.forget()

    def forget(self) -> None:
        """Drop all history, as before the first frame."""
        self.beliefs: list[Track] = []
        self.locked = False
        self.margin = 0.0
        self._failures = 0
        self._stage: Stage = "search"
        self._last: Detections | None = None
        self._slow: tuple[Array, Array] | None = None
        self._ahead: _Ahead | None = None
        if self.scan is not None:
            self.scan.forget()

    def process(self, frame: Frame) -> Fix:
        """Image door. Raises: FrameError when the image is not of the camera's size."""
        height, width = frame.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            wanted = f"{self.camera.width}x{self.camera.height}"
            raise FrameError("bad_frame", f"frame {frame.name} is {width}x{height}, the calibration {wanted}")
        if self.scan is None or not self.scan.fits(frame):
            self.scan = detect.Scan(frame, self.config.detect)
        detections = detect.lights(frame, self.config.detect, self.scan, self.foreseen(frame))
        return self.process_detections(layers.label(frame, detections, self.config.label, self.scan.saturated))

    def foreseen(self, frame: Frame) -> Array | None:
        """Where the lights will be (n, 3) u, v, reach px, while the track holds; None asks for a full search."""
        t_ns = frame.t_ns
        if self.cold or not self.locked or self._failures or self._last is None or t_ns <= self._last.t_ns:
            return None
        belief = self.beliefs[0]
        if belief.t_ns < self._last.t_ns or t_ns - belief.lights_ns > self.config.track.max_gap_s * 1e9:
            return None
        moved = track.predict(belief, t_ns, self.config.track)
        self._ahead = _Ahead(belief, moved, track.look(moved, self._plan))
        return track.foresee(self._ahead.view)

    def process_detections(self, detections: Detections) -> Fix:
        """Light door: detections from another detector, or from `process`."""
        if self.cold:
            self.forget()
        reason = self._refuse(detections)
        self._last = detections
        if reason == "bad_stamp":
            return self._no_fix(detections, "none", reason)
        before = self.beliefs
        self.beliefs = self._predict(before, detections)
        if not self.beliefs:
            self._lose(before)
        elif self.beliefs[0].proof == 0:  # what one frame once decided no longer stands for the names
            self.margin = min(self.margin, self.config.integrity.evidence)
        if reason:
            return self._no_fix(detections, "coasting" if self.locked else "none", reason)
        return self._localize(detections)

    def _localize(self, detections: Detections) -> Fix:
        """Both doors meet here: warm first, then cold; then what may be said."""
        seen = match.spots(detections, self._plan, self.config.match)
        followed = self._follow(self.beliefs, seen)
        held = self.locked and bool(followed) and self._holds(followed[0], seen)
        self._failures = 0 if held else self._failures
        if held and not self._overlooks(followed[0], seen):
            self.beliefs = followed
            return self._conclude(detections, "tracking")
        self._failures += 1
        doubt = self._doubt(followed, seen)
        if self.locked and doubt == "residual" and not held and self._failures == 1:
            return self._coast(detections, doubt)  # one in many thousands fails by chance
        found = self._acquire(detections, seen)
        if held and not track.is_joint(
            verify.names_of(found, self.config.match, len(self.station)), self._plan, self.config.track
        ):
            self.beliefs = followed
            return self._conclude(detections, "tracking")
        if held:  # what the track has learned while it overlooked a layer is in doubt too
            self.locked, self._slow = False, None
        held_still = followed[:1] if held else []
        if verify.is_answer(found, self.config.match) and self._lock(found, detections, seen, held_still):
            return self._conclude(detections, "acquired")
        if self.locked:
            return self._coast(detections, doubt or _why(detections, found))
        if not self.cold and self._gather(followed, found, detections, seen):
            return self._conclude(detections, "acquired")
        return self._no_fix(detections, "none", _why(detections, found))

    def _predict(self, beliefs: list[Track], detections: Detections) -> list[Track]:
        """Beliefs at the time of this frame; those without lights for too long, or from the future, are dropped."""
        config, t_ns, later, ahead = self.config.track, detections.t_ns, [], self._ahead
        for belief in beliefs:
            if belief.t_ns < t_ns <= belief.lights_ns + config.max_gap_s * 1e9:
                known = ahead is not None and ahead.belief is belief and ahead.moved.t_ns == t_ns
                moved = ahead.moved if ahead and known else track.predict(belief, t_ns, config)
                later.append(track.attend(moved, detections.attitude) if detections.attitude else moved)
        return later

    def _lose(self, before: list[Track]) -> None:
        """Give up a lock, but for what the track has learned of survey and calibration."""
        if self.locked and before[0].joint:
            self._slow = track.learned(before[0])
        self.locked = False

    def _follow(self, beliefs: list[Track], seen: Spots) -> list[Track]:
        """The beliefs that find lights in this frame, with these taken in, the likeliest first.

        One whose pose does not settle cannot be judged, and the others must not win for want of it: it is kept as it
        was predicted. A lock follows none that is first.
        """
        followed, unjudged = [], []
        for belief in beliefs:
            ahead = self._ahead
            view = ahead.view if ahead and ahead.moved is belief else None
            found = track.associate(belief, seen, self._plan, self.config, view)
            if found.log_evidence == -math.inf:
                return []
            if not (found.name >= 0).any():
                continue
            updated = track.update(
                belief, found.name, seen, self._plan, self.config.track, log_evidence=found.log_evidence
            )
            if updated is None:
                weight = belief.log_weight + found.log_evidence
                count = self._plan.count(found.name)
                unjudged.append(replace(belief, log_weight=weight, name=found.name, count=count))
            else:
                followed.append(updated)
        kept = self._likeliest([*followed, *unjudged])
        return [] if self.locked and kept and kept[0] in unjudged else kept

    def _likeliest(self, beliefs: list[Track]) -> list[Track]:
        """The likeliest first, without those that are out of the question or the same as a likelier one."""
        beliefs = sorted(beliefs, key=lambda belief: -belief.log_weight)
        kept: list[Track] = []
        for belief in beliefs[: self.config.track.hypotheses]:
            far_behind = belief.log_weight < beliefs[0].log_weight - self.config.track.forget
            if not far_behind and not any(track.same(belief, other) for other in kept):
                kept.append(belief)
        return kept

    def _holds(self, belief: Track, seen: Spots) -> bool:
        """Whether a followed belief passes its tests, with lights enough.

        Three lights of one plane fit many poses: only a track that has seen two layers lives on less than four.
        """
        return belief.n_used >= (1 if belief.joint else _MIN_SOLID) and self._fits(belief, seen)

    def _fits(self, belief: Track, seen: Spots) -> bool:
        """Whether a followed belief passes its innovation test and leaves no array's worth of spots unexplained."""
        used = belief.n_used
        explains = used >= _MIN_LIGHTS or seen.lamps - used < _MIN_SOLID
        return explains and verify.innovation_holds(belief, self.config.track)

    def _doubt(self, followed: list[Track], seen: Spots) -> str:
        """The word for followed beliefs that do not hold: `too_few` where nothing speaks against what is seen."""
        if not followed:
            return ""
        return "too_few" if self._fits(followed[0], seen) else "residual"

    def _overlooks(self, belief: Track, seen: Spots) -> bool:
        """Whether a second layer may be in view where the tilt was too open, or too wrong, to expect it there."""
        if self._plan.n_layers == 1 or seen.lamps - belief.n_used < _MIN_SOLID:
            return False
        lately = np.array(belief.layer_ns) > belief.t_ns - self.config.track.max_gap_s * 1e9
        named = np.bincount(self._plan.layer[belief.name >= 0], minlength=self._plan.n_layers) > 0
        return not belief.joint or bool((lately & ~named).any())

    def _acquire(self, detections: Detections, seen: Spots) -> Acquisition:
        expected = match.prior(detections.attitude, self.config.prior)
        return match.acquire(seen, self._plan, self.camera, expected, self.config.match)

    def _start(self, naming: Hypothesis, detections: Detections, seen: Spots) -> Track | None:
        """A new track from one naming, with what is known of survey and calibration; None for two names or fewer."""
        if int((naming.name >= 0).sum()) < _MIN_LIGHTS:
            return None
        expected = match.prior(detections.attitude, self.config.prior)
        slow = self._slow or track.slow_states(self.station, detections.attitude)
        begun = track.start(
            naming.T_cam_dock, naming.name, detections.t_ns, seen, self._plan, expected, slow, self.config.track
        )
        return None if begun is None else replace(begun, log_weight=naming.log_evidence)

    def _lock(self, found: Acquisition, detections: Detections, seen: Spots, held: list[Track]) -> bool:
        """Believe an answer, its flip and, with history, what contradicts it and is not yet out of the question.

        A track that still holds against the answer is believed as much, until the next frames tell.
        """
        head = found.candidates[0]
        rivals = [c for c in found.candidates[1:] if verify.contradict(c.name, head.name)]
        namings = [head, *found.others, *([] if self.cold else rivals[:_MAX_RIVALS])]
        if self.locked and self.beliefs[0].joint:
            self._slow = track.learned(self.beliefs[0])
        begun = self._begin(namings, detections, seen)
        if not begun and self._slow is not None:  # what an earlier track has learned may be wrong
            learned, self._slow = self._slow, None
            begun = self._begin(namings, detections, seen)
            self._slow = None if begun else learned
        if not begun:
            return False
        self.beliefs = self._likeliest([*(replace(b, log_weight=head.log_evidence) for b in held), *begun])
        self.locked, self.margin = True, max(found.certainty, self.config.match.margin)
        return True

    def _begin(self, namings: list[Hypothesis], detections: Detections, seen: Spots) -> list[Track]:
        """Tracks from namings; none where the first does not pass its test."""
        first, *rest = [self._start(naming, detections, seen) for naming in namings]
        if first is None or not verify.innovation_holds(first, self.config.track):
            return []
        return [first, *(belief for belief in rest if belief is not None)]

    def _gather(self, followed: list[Track], found: Acquisition, detections: Detections, seen: Spots) -> bool:
        """Follow every naming that one frame leaves open until one stands out, in this frame too.

        A naming that this frame gives again starts anew from its pose now, with the weight that it has gathered.
        """
        new = [*found.candidates, *found.others][: self.config.track.hypotheses]
        begun = [self._renew(naming, new, followed, detections, seen) for naming in new]
        others = [b for b in followed if not any((b.name == naming.name).all() for naming in new)]
        self.beliefs = self._likeliest([*others, *(belief for belief in begun if belief is not None)])
        if found.reason == "mirror" or not self.beliefs or not verify.gathered(self.beliefs, found, self.config):
            return False
        self.locked, self.margin = verify.innovation_holds(self.beliefs[0], self.config.track), 0.0
        return self.locked

    def _renew(
        self,
        naming: Hypothesis,
        new: list[Hypothesis],
        followed: list[Track],
        detections: Detections,
        seen: Spots,
    ) -> Track | None:
        """A track from a naming, which takes over what the same names have gathered; a flip keeps its distance."""
        begun = self._start(naming, detections, seen)
        before = next((belief for belief in followed if (belief.name == naming.name).all()), None)
        if begun is None or before is None:
            return begun or before
        best = max(other.log_evidence for other in new if (other.name == naming.name).all())
        weight = before.log_weight + naming.log_evidence - best
        return replace(begun, log_weight=weight, began_ns=before.began_ns, proof=before.proof)

    def _conclude(self, detections: Detections, status: Status) -> Fix:
        """The fix of the likeliest belief, as far as it can be trusted."""
        first, config = self.beliefs[0], self.config.integrity
        bound = integrity.bounds(self.beliefs, config)
        proven = verify.is_proven(first, self.margin, config)
        valid, used = proven and integrity.pose_holds(bound, self.station.alert_limits), first.n_used
        self._stage = integrity.stage(first, self._plan) or self._stage
        return Fix(
            detections.frame,
            detections.t_ns,
            status,
            self._stage,
            n_seen=len(detections),
            n_used=used,
            T_dock_cam=bound.T_dock_cam if valid else None,
            reason="" if valid else "protection" if proven else "ambiguous",
            match=Match(detections, match.light_of(first.name, len(detections))),
            covariance=bound.covariance if valid else None,
            protection=bound.protection if valid else None,
            guide=bound.guide if proven and integrity.guide_holds(bound, self.station.alert_limits) else None,
            nis=first.nis / (2 * used) if status == "tracking" else math.nan,
        )

    def _coast(self, detections: Detections, reason: str) -> Fix:
        """No light fits: a failed test ends trust at once, a dark frame when the last light is too old."""
        nothing = np.full(len(self.station), -1, np.int64)
        none, failed = self._plan.count(nothing), reason == "residual"
        self.beliefs = [replace(b, name=nothing, count=none, proof=0 if failed else b.proof) for b in self.beliefs]
        age_s = (detections.t_ns - self.beliefs[0].lights_ns) * 1e-9
        if self.beliefs[0].proof == 0:  # nothing has agreed since a test failed, or for too long
            return self._no_fix(detections, "coasting", "residual")
        if age_s > self.config.integrity.max_age_s:
            return self._no_fix(detections, "coasting", "stale")
        return self._conclude(detections, "coasting")

    def _refuse(self, detections: Detections) -> str:
        """The word for a frame that cannot be used, or nothing.

        A stamp that does not follow the one before gives no fix; the next is measured against it, so that a clock that
        was set back costs one frame and the history.
        """
        if self._last is not None and detections.t_ns <= self._last.t_ns:
            return "bad_stamp"
        if self._last is not None and len(detections) and np.array_equal(detections.uv, self._last.uv):
            return "frozen"
        return "too_many" if len(detections) > _MAX_SPOTS else ""

    def _no_fix(self, detections: Detections, status: Status, reason: str) -> Fix:
        unnamed = Match(detections, np.full(len(detections), -1, np.int64))
        frame, t_ns, seen = detections.frame, detections.t_ns, len(detections)
        return Fix(frame, t_ns, status, self._stage, n_seen=seen, reason=reason, match=unnamed)


def _why(detections: Detections, found: Acquisition) -> str:
    """The word for a frame that named nothing."""
    if len(detections) < 3:
        return "too_few" if len(detections) else "no_lights"
    return found.reason
