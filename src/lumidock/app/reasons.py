"""What each reason of a fix means, in a sentence, and what to try first; docs/reasons.md holds the same."""

from __future__ import annotations

from dataclasses import dataclass

from lumidock.datatypes import Fix


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a frame has no valid pose, and the remedy."""

    meaning: str
    remedy: str


REASONS = {
    "no_lights": Reason(
        "Nothing in the image could be a light.",
        "Check that the lamps are on, the exposure, and the range at which the water lets them be seen.",
    ),
    "too_few": Reason(
        "Fewer lights were identified than a pose or the proof of an association needs.",
        "Come nearer or turn toward the dock; add lights that stay in view (`lumidock station check`).",
    ),
    "too_many": Reason(
        "The frame has more detections that look like lamps than the search can look at within `match.max_work`.",
        "Dim the vehicle's own lamp, or use a detector that gives fewer false detections.",
    ),
    "ambiguous": Reason(
        "Several associations fit about as well.",
        "Provide an attitude sensor, come nearer, or make the layout less symmetric (`lumidock station check`).",
    ),
    "unproven": Reason(
        "One association fits, and its evidence does not yet meet the stated risk.",
        "Wait for more frames, other lights or another viewpoint.",
    ),
    "mirror": Reason(
        "The mirror image of the array fits about as well as the array.",
        "Look from below or beside the line to the mirrored image; provide an attitude sensor.",
    ),
    "inconsistent": Reason(
        "The detections fit no arrangement of the station's lights.",
        "Check that the station file describes this dock.",
    ),
    "residual": Reason(
        "The identified lights do not lie where any one pose puts them, so the track is not used in this frame.",
        "One frame: nothing. Many: check calibration and station file.",
    ),
    "protection": Reason(
        "A pose was found, but its protection level is over the alert limit; `run` says which level, and by how much.",
        "Come nearer, light more lamps, survey the dock more exactly, or provide an attitude sensor.",
    ),
    "saturated": Reason(
        "The lights show too little for a valid pose, and their cores or the whole image are overexposed.",
        "Shorten the exposure, or multiply it by the fix's `exposure_factor` ([how](detector.md#9-exposure)).",
    ),
    "calibration": Reason(
        "What is seen contradicts the camera file; `run` and the report say what about it.",
        "Calibrate the camera in water, at the size and crop of these images.",
    ),
    "survey": Reason(
        "What is seen contradicts the station file; `run` and the report name the light or the layer.",
        "Survey the dock again, or state how far off its lights may be "
        "([how](safety-case.md#how-smaller-errors-are-earned)).",
    ),
    "stale": Reason(
        "No light was seen for too long to go on predicting.",
        "None; tracking resumes with the lights.",
    ),
    "frozen": Reason(
        "The image repeats while the vehicle moves.",
        "Check the camera, its driver or the network.",
    ),
    "bad_frame": Reason(
        "The image could not be read, or its size differs from the calibration's.",
        "Check the file, or the calibration's size.",
    ),
    "bad_stamp": Reason(
        "The time stamp is missing or does not follow the one before.",
        "Check the clock of the camera or of the recording.",
    ),
}
_UNKNOWN = Reason("The method gives this reason itself.", "See the description of the method.")


def explain(fix: Fix) -> Reason:
    """Why the pose of a fix may or may not be used, and what to do."""
    if fix.valid:
        return Reason("The full pose may be used.", "")
    reason = REASONS.get(fix.reason, _UNKNOWN)
    if fix.guide is None:
        return reason
    return Reason(f"Bearing and range may be used, the pose may not: {_continued(reason.meaning)}", reason.remedy)


def _continued(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]
