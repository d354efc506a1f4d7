"""How many lights a decision needs: every such threshold of the estimator, each with its geometric reason."""

POSE_LIGHTS = 3
"""A light gives two pixel coordinates, a pose has six unknowns: three lights fit one, in up to four ways."""

CHECKED_LIGHTS = 4
"""With a fourth light there are more pixels than unknowns: it decides among the poses of three, and can disagree.

So four lights are the least of an association that one frame alone decides, of a frame that counts as agreeing with a
track, and of detections left over that may be an array of their own.
"""

LAYER_LIGHTS = 3
"""Fewer lights of a second layer would set the tilt of the pose alone; the third has to agree with the other two."""

JOINT_TRACK_LIGHTS = 1
"""A track that has seen two layers together knows its tilt, and may live on a single light."""

MAX_SUBSETS = 8
"""A tracked frame costs some 40 us for each. Lights of two layers share one: with one layer in view nothing is lost."""

MAX_LIGHTS = 128
"""Of a station: the filter carries three states a light, and a covariance of (18 + 3 * 128)^2 numbers is 1.3 MB."""

MAX_DETECTIONS = 200
"""Of one frame: association and acquisition grow with their number; a frame with more is refused as `too_many`."""
