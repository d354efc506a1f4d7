"""The four docking stages and the hand-over from the front to the rear layer, paper sections 2.2 and 4.2."""

from __future__ import annotations

from lumidock.datatypes import LayerPose, Stage
from lumidock.paper.layer import MIN_FOR_SWARM


class Guidance:
    """Chooses the layer that guides, and the stage of the docking; remembers both.

    `layers` are (name, number of lights), front first; with one layer there is no hand-over.
    """

    def __init__(self, layers: list[tuple[str, int]]) -> None:
        self._front, self._n_front = layers[0]
        self._rear, self._n_rear = layers[1] if len(layers) > 1 else ("", 0)
        self._on_rear = False
        self.stage: Stage = "search"

    def choose(self, poses: dict[str, LayerPose]) -> LayerPose | None:
        """The pose that guides in this frame: the rear layer's from the frame on that shows all of its lights.

        A pose of three lights, carried by history, gives way to one that stands on its own.
        """
        front, rear = poses.get(self._front), poses.get(self._rear)
        self.stage = self._next_stage(front, rear)
        self._on_rear |= rear is not None and rear.n_used == self._n_rear
        if front is None or rear is None:
            return rear or front
        carried = rear.n_used < MIN_FOR_SWARM <= front.n_used
        return rear if self._on_rear and not carried else front

    def _next_stage(self, front: LayerPose | None, rear: LayerPose | None) -> Stage:
        if front is not None and rear is not None:
            return "transition"
        if rear is not None:
            return "rear"
        if front is None:
            return self.stage
        return "front" if front.n_used == self._n_front or self.stage in ("front", "transition") else "search"
