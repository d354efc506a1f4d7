"""The paper's method, a file per step: from a frame, or from its detections, to a fix.

Source: "Robust Underwater Docking Visual Guidance and Positioning Method Based on a Cage-Type Dual-Layer Guiding Light
Array", Sensors 2025, 25, 6333. Section and equation numbers in this folder are that paper's.
"""

from lumidock.paper.localizer import PaperLocalizer

__all__ = ["PaperLocalizer"]
