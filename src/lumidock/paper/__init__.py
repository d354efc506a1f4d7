"""The method of "Robust Underwater Docking Visual Guidance and Positioning Method Based on a Cage-Type Dual-Layer Guiding
Light Array", Sensors 2025, 25, 6333: a file per step, the same two doors as the default method."""

from lumidock.paper.localizer import PaperLocalizer

__all__ = ["PaperLocalizer"]
