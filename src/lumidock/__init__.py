"""lumidock: the pose of an underwater vehicle relative to its dock, from one camera and the dock's guiding lights."""
