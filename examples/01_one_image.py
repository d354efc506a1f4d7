"""One picture in, the pose of the camera out.

python examples/01_one_image.py PICTURE STATION CAMERA
(lumidock sim approach --out SEQ leaves all three: SEQ/frames/000120.jpg SEQ/station.yaml SEQ/camera.yaml)
"""

import sys
from pathlib import Path

import cv2

from lumidock import Frame, Localizer, load_camera, load_station

if len(sys.argv) != 4:
    sys.exit(__doc__)
picture, station, camera = map(Path, sys.argv[1:4])
localizer = Localizer(load_station(station), load_camera(camera))
fix = localizer.process(Frame(picture.stem, t_ns=0, image=cv2.imread(str(picture))))
if fix.valid:
    x, y, z = fix.T_dock_cam[:3, 3]  # p_dock = T_dock_cam @ p_cam
    print(f"camera at x {x:+.3f}, y {y:+.3f}, z {z:+.3f} m in the dock frame, by {fix.n_used} lights")
    print(f"once in a million frames the lateral error is over {fix.protection.lateral_m:.3f} m")
elif fix.guide is not None:
    print(f"no pose ({fix.reason}), but the dock is {fix.guide.range_m:.2f} m away")
else:
    print(f"no fix: {fix.reason}")
