"""What the paper says of its own method, as data.

Source: Robust Underwater Docking Visual Guidance and Positioning Method Based on a Cage-Type Dual-Layer Guiding Light
Array, Sensors 2025, 25, 6333; the place stands beside each figure.
"""

from __future__ import annotations

# Table 1: (missing, spurious) front lights -> percent right by the swarm, and with the backtracking filter
TABLE_1 = {
    (3, 0): (90.3, 100.0),
    (2, 0): (98.6, 100.0),
    (1, 0): (100.0, 100.0),
    (0, 1): (99.6, 100.0),
    (0, 2): (99.6, 99.9),
}
DISTANCES_M = (9.0, 5.0, 3.0)  # figures 9 and 10
FRONT_Z_M = (18.62, 1.73)  # section 4.2, figure 16: first and last fix of the front layer
REAR_FIRST_Z_M = 10.07  # section 4.2, figure 16
DOCKING_PLANE_Z_M = -3.0  # section 4.2
LAYER_OFFSET_M = 0.3  # section 4.2: the offset between the layers' centres stays below
AXIS_M = 1.0  # section 4.2: the vehicle stays within this of the axis
DUAL_LAYER_MS, SINGLE_LAYER_MS, FRAME_MS = 112.0, 97.0, 150.0  # section 4.2: detection and matching, and the budget
# section 4.1: frames with all front lights; those with lights missing are not counted apart, so the first one stands
TABLE_1_FRAMES = {(3, 0): 2108, (2, 0): 2108, (1, 0): 2108, (0, 1): 2076, (0, 2): 2153}
SEARCH_Z_M = 15.0  # section 4.1 (3): the plane of the rectangular search
