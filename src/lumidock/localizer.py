"""The default method: one frame, from pixels or detections, to a fix.

`Localizer` is its only stateful class; everything else is functions of a state that is passed in and out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lumidock import acquisition, detect, exposure, integrity, layers, tracking, verify
from lumidock.acquisition import Moment
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import AidingMeasurement, Array, Detections, Fix, Frame
from lumidock.digest import Digest
from lumidock.errors import FrameError, InputError
from lumidock.light_counts import CHECKED_LIGHTS, MAX_DETECTIONS, MAX_LIGHTS, MAX_TRACK_BYTES, POSE_LIGHTS
from lumidock.match import Acquisition
from lumidock.model import count_lamps, measurements, possible_lamps
from lumidock.state import Context, LocalizerState
from lumidock.station import Station
from lumidock.track import Track, learned_calibration, sees_two_layers, track_bytes
from lumidock.tracking import Prediction

_SHOWS_TOO_LITTLE = ("no_lights", "too_few", "inconsistent", "residual", "protection")
_SHOWS_ANYTHING = ("too_many", "ambiguous", "unproven")  # in a picture that is overexposed as a whole


class Localizer:
    """Frames or detections in, one fix each out; remembers the frames before, in `state`, unless `cold`."""

    def __init__(self, station: Station, camera: Camera, config: Config | None = None, *, cold: bool = False) -> None:
        """Raises: InputError for a station with more lights, or more hypotheses of it, than the filter can carry."""
        if len(station) > MAX_LIGHTS:
            raise InputError(f"{station.name}: {len(station)} lights; wanted at most {MAX_LIGHTS}")
        self.station, self.camera, self.cold = station, camera, cold
        self.config = config or Config()
        most = MAX_TRACK_BYTES // track_bytes(len(station))
        if self.config.track.hypotheses > most:
            wanted = f"track.hypotheses: {self.config.track.hypotheses} of {len(station)} lights do not fit in memory"
            raise InputError(f"{station.name}: {wanted}; wanted at most {most}")
        self.context = Context.of(station, camera, self.config, cold=cold)
        self.state = LocalizerState()
        self.scan: detect.Scan | None = None

    def forget(self) -> None:
        """Drop all history, as before the first frame."""
        self.state = LocalizerState()
        if self.scan is not None:
            self.scan.forget()

    def aid(self, measurement: AidingMeasurement) -> None:
        """Give a value of one of the vehicle's sensors; it counts from the next frame on, at the time it was measured.

        Values may come in any order and at any rate; one that belongs before a frame should come before that frame.
        """
        self.state = replace(self.state, aiding=self.state.aiding.with_value(measurement))

    def process(self, frame: Frame) -> Fix:
        """The fix of one frame's image. Raises: FrameError when the image is not of the camera's size."""
        height, width = frame.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            wanted = f"{self.camera.width}x{self.camera.height}"
            raise FrameError("bad_frame", f"frame {frame.name} is {width}x{height}, the calibration {wanted}")
        if self.cold:
            self.forget()
        digest = self.state.digest
        self.state = replace(self.state, digest=digest.next(frame.image) if digest else Digest.of(frame.image))
        if self.scan is None or not self.scan.fits(frame):
            self.scan = detect.Scan(frame, self.config.detect, self.camera.focal_px[0] / self.camera.focal_px[1])
        predicted = tracking.predict(self.state, frame.t_ns, self.context)
        found = detect.lights(frame, self.config.detect, self.scan, predicted.windows())
        fix = self._step(layers.label(frame, found, self.config.label, self.scan.saturated), predicted)
        return _overexposed(fix, self.scan.glare)

    def process_detections(self, detections: Detections) -> Fix:
        """The fix of one frame's detections, by a detector of one's own."""
        if self.cold:
            self.forget()
        self.state = replace(self.state, digest=None)
        return self._step(detections, tracking.predict(self.state, detections.t_ns, self.context))

    def search_windows(self, frame: Frame) -> Array | None:
        """Where `process` would look for lights (n, 3): u, v, reach px; None: in all of the frame."""
        return None if self.cold else tracking.predict(self.state, frame.t_ns, self.context).windows()

    def _step(self, detections: Detections, predicted: Prediction) -> Fix:
        fix, self.state = step(self.state, detections, predicted, self.context)
        return fix


def _overexposed(fix: Fix, glare: float) -> Fix:
    """The same fix; where it lacks what the picture should show and that is too bright, `saturated` is the reason.

    `glare`: share of the picture that is saturated.
    """
    words = _SHOWS_TOO_LITTLE + _SHOWS_ANYTHING * (glare > exposure.GLARE)
    return replace(fix, reason="saturated") if fix.exposure_factor < 1.0 and fix.reason in words else fix


def step(
    state: LocalizerState, detections: Detections, predicted: Prediction, context: Context
) -> tuple[Fix, LocalizerState]:
    """The fix of one frame's detections, and the next state; `predicted` is the state at the time of the frame."""
    refused = _why_refused(state.last, detections)
    if refused == "bad_stamp":
        return integrity.no_fix(state, detections, "none", refused), replace(state, last=detections)
    state, predicted = replace(state, aiding=predicted.aiding), predicted.with_attitude(detections.attitude)
    frame = measurements(detections, context.model, context.config.match)
    refused = refused or ("frozen" if tracking.is_frozen(state, predicted, frame, context) else "")
    state = replace(_arrived(state, detections, predicted, context), frozen=refused == "frozen")
    if refused:
        return integrity.no_fix(state, detections, "coasting" if state.confirmed else "none", refused), state
    followed = tracking.follow(predicted, frame, context, confirmed=state.confirmed)
    moment = Moment(detections.t_ns, frame, detections.attitude, context)
    if state.confirmed and followed and verify.holds(followed[0], count_lamps(frame), context.config.track):
        return _tracked(_told_of_distortion(state, predicted, followed, moment), followed, detections, moment)
    return _lost(replace(state, failures=state.failures + 1), followed, detections, moment)


def _told_of_distortion(
    state: LocalizerState, predicted: Prediction, followed: Sequence[Track], moment: Moment
) -> LocalizerState:
    """The state with the frame's innovation weighed against a distortion that the calibration leaves out."""
    expected, one = predicted.measurements, followed[0]
    if expected is None or not predicted.tracks[0].estimates_calibration or len(followed) > 1:
        return state
    return replace(
        state,
        distortion=state.distortion.with_frame(expected, one.last.assignment, moment.frame, moment.context.camera),
    )


def _why_refused(last: Detections | None, detections: Detections) -> str:
    """The word for a frame that cannot be used, or nothing.

    A stamp that does not follow the one before gives no fix and is the reference of the next one. So after a clock was
    set back one frame is refused, and the track is dropped with the next, since it lies in that frame's future.
    """
    if last is not None and detections.t_ns <= last.t_ns:
        return "bad_stamp"
    if last is not None and len(detections) and np.array_equal(detections.uv, last.uv):
        return "frozen"
    return "too_many" if possible_lamps(detections) > MAX_DETECTIONS else ""


def _arrived(state: LocalizerState, detections: Detections, predicted: Prediction, context: Context) -> LocalizerState:
    """The state at the time of a frame. Of a track that is lost only what it learned of the calibration stays."""
    if predicted.tracks:
        margin = verify.remaining_margin(predicted.tracks[0], state.margin, context.config.integrity)
        return replace(state, last=detections, hypotheses=predicted.tracks, margin=margin)
    calibration = state.calibration
    if state.confirmed and state.first.estimates_calibration:
        calibration = learned_calibration(state.first)
    if predicted.deceived:  # what a track has learned from a sensor that lies is wrong too
        calibration = None
    return replace(state, last=detections, hypotheses=(), confirmed=False, calibration=calibration)


def _tracked(
    state: LocalizerState, followed: Sequence[Track], detections: Detections, moment: Moment
) -> tuple[Fix, LocalizerState]:
    """A confirmed track holds; where it is not proven or may overlook a layer, the frame is acquired anew."""
    context, first = moment.context, followed[0]
    tracked = _checked(replace(state, hypotheses=tuple(followed), failures=0, dark_frames=0), moment)
    if sees_two_layers(first.last.count):
        tracked = replace(tracked, contradiction=None)
    overlooks = tracking.overlooks(first, moment.frame, context)
    proven = verify.is_proven(first, tracked.margin, context.config.integrity)
    provable = not proven and first.last.n_used >= CHECKED_LIGHTS
    if not (provable or overlooks):
        return integrity.assess(tracked, detections, "tracking", context)
    found = moment.acquire()
    same_array = verify.finds_array(found, first.last.assignment, context.config.match)
    elsewhere = verify.is_answer(found, context.config.match) and not same_array
    if (overlooks and _shows_two_layers(found, context)) or (provable and elsewhere):
        # what the track has learned meanwhile is in doubt too; a failure, so that the next search is full
        doubted = replace(state, confirmed=False, calibration=None, failures=1)
        return _acquired(doubted, followed, detections, moment, found, still_held=followed[:1])
    if provable and same_array:
        tracked = replace(tracked, margin=max(tracked.margin, found.certainty))
    if overlooks:
        against = moment.displaced_layer(first) or tracked.contradiction
        tracked = replace(tracked, failures=1, contradiction=against)
    return integrity.assess(tracked, detections, "tracking", context)


def _checked(state: LocalizerState, moment: Moment) -> LocalizerState:
    """Count successive frames with fewer than four lights; after some of them a fresh acquisition has to agree.

    A mirror image or another array may have taken over in the meantime, and would go on agreeing with itself.
    """
    config, used = moment.context.config, state.first.last.n_used
    if used < CHECKED_LIGHTS:
        return replace(state, thin_frames=state.thin_frames + 1)
    state = replace(state, twin=moment.shows_twin(state.first.last.assignment))
    if state.thin_frames < config.integrity.thin_frames:
        return replace(state, thin_frames=0)
    found = moment.acquire(all_mirrors=True)
    agrees = verify.agrees(found, state.first.last.assignment, config.match)
    return replace(state, thin_frames=0) if agrees else state


def _shows_two_layers(found: Acquisition, context: Context) -> bool:
    """Whether one frame alone decides on an association with lights enough of two layers."""
    if not verify.is_answer(found, context.config.match):
        return False
    return sees_two_layers(context.model.count(found.hypotheses[0].assignment))


def _lost(
    state: LocalizerState, followed: Sequence[Track], detections: Detections, moment: Moment
) -> tuple[Fix, LocalizerState]:
    """No confirmed track holds: the frame is acquired, unless it is the first to fail its test after one that held."""
    doubt, dark = _doubt(followed, moment), not followed and count_lamps(moment.frame) < CHECKED_LIGHTS
    state = replace(state, dark_frames=state.dark_frames + 1 if dark else 0)
    if state.confirmed and followed and doubt == "residual" and state.failures == 1:  # one in many thousands, by chance
        return _coasting(state, detections, moment.context, doubt)
    found, held = moment.acquire(), followed[:1] if state.confirmed and doubt == "too_few" else ()
    # three lights prove nothing, but the track that they hold is not given up for another array of one frame
    if held and verify.finds_array(found, held[0].last.assignment, moment.context.config.match):
        held = ()
    return _acquired(state, followed, detections, moment, found, doubt=doubt, still_held=held)


def _doubt(followed: Sequence[Track], moment: Moment) -> str:
    """The word for hypotheses that do not hold: `too_few` where nothing speaks against what is seen.

    Lamps enough for a pose of which none is where it was predicted speak against the prediction.
    """
    lamps, config = count_lamps(moment.frame), moment.context.config.track
    if not followed:
        return "residual" if lamps >= CHECKED_LIGHTS else ""
    return "too_few" if verify.explains(followed[0], lamps, config) else "residual"


def _acquired(
    state: LocalizerState,
    followed: Sequence[Track],
    detections: Detections,
    moment: Moment,
    found: Acquisition,
    *,
    doubt: str = "",
    still_held: Sequence[Track] = (),
) -> tuple[Fix, LocalizerState]:
    """What an acquisition gives: a track confirmed by this frame, or by several; else coasting, or no fix."""
    context = moment.context
    answer = verify.is_answer(found, context.config.match)
    if answer and moment.shows_twin(found.hypotheses[0].assignment):
        return integrity.no_fix(state, detections, "none", "ambiguous"), replace(state, confirmed=False, hypotheses=())
    if answer:
        state, confirmed = acquisition.confirm(state, found, moment, still_held)
        if confirmed:
            return integrity.assess(state, detections, "acquired", context)
    reason = _why_nothing(detections, found)
    if state.confirmed:
        return _coasting(state, detections, context, doubt or reason)
    if not context.cold:
        state = acquisition.gather(state, followed, found, moment)
        if state.confirmed:
            return integrity.assess(state, detections, "acquired", context)
    return integrity.no_fix(state, detections, "none", reason), state


def _why_nothing(detections: Detections, found: Acquisition) -> str:
    """The word for a frame without an association."""
    if len(detections) < POSE_LIGHTS:
        return "too_few" if len(detections) else "no_lights"
    return found.reason


def _coasting(
    state: LocalizerState, detections: Detections, context: Context, reason: str
) -> tuple[Fix, LocalizerState]:
    """The predicted pose of a confirmed track in a frame that gives no accepted update; `reason` says why."""
    tracks = tracking.coast(state.hypotheses, context, failed=reason == "residual")
    state = replace(state, hypotheses=tracks, thin_frames=state.thin_frames + 1)
    return integrity.assess(state, detections, "coasting", context)
