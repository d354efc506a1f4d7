"""An array of your own: write it down, look at it from 6 m, and see what its lights give.

python examples/03_own_array.py
"""

import tempfile
from pathlib import Path

import numpy as np
import yaml

from lumidock import Detections, Localizer, load_camera, load_station
from lumidock.pose import project_lights

# +x right as the vehicle sees the dock, +y up, +z out of the dock toward the vehicle, metres
LIGHTS = {
    "A": (-0.9, 0.5, 0.0),
    "B": (0.8, 0.7, 0.0),
    "C": (0.9, -0.6, 0.0),
    "D": (-0.2, -0.9, 0.0),
    "E": (-0.8, -0.5, 0.0),
    "F": (0.1, 0.2, 0.6),  # off the plane of the others: tells lateral position from tilt
}
content = {
    "schema": 1,
    "name": "my-dock",
    "lights": [{"id": name, "layer": "frame", "position": list(at)} for name, at in LIGHTS.items()],
}
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "dock.yaml"
    file.write_text(yaml.safe_dump(content))
    station = load_station(file)
camera = load_camera(Path(__file__).parents[1] / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml")

T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])  # head-on
T_dock_cam[:3, 3] = 0.3, -0.2, 6.0
uv = project_lights(camera, T_dock_cam, station.p_dock)
rng, localizer = np.random.default_rng(0), Localizer(station, camera)
for number in range(5):
    noisy = uv + rng.normal(0.0, 0.3, uv.shape)  # exactly the same detections again would be reported as a frozen image
    fix = localizer.process_detections(Detections.from_uv(str(number), number * 100_000_000, noisy))
assert fix.match is not None
print("named:", ", ".join(station.ids[light] for light in fix.match.light if light >= 0))
if fix.valid:
    print("camera at", np.round(fix.T_dock_cam[:3, 3], 3), "true", T_dock_cam[:3, 3])
