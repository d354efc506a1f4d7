"""A video, frame by frame, with history.

python examples/02_video.py VIDEO STATION CAMERA
"""

import sys
from pathlib import Path

from lumidock import Frame, Localizer, load_camera, load_station
from lumidock.streams.sources import open_source

if len(sys.argv) != 4:
    sys.exit(__doc__)
video, station, camera = map(Path, sys.argv[1:4])
localizer = Localizer(load_station(station), load_camera(camera))
for item in open_source(video).items():
    if not isinstance(item, Frame):  # a frame that could not be decoded
        print(item.frame, item.text)
        continue
    fix = localizer.process(item)
    where = f"z {fix.T_dock_cam[2, 3]:+.2f} m" if fix.valid else fix.reason
    print(f"{fix.t_ns * 1e-9:7.2f} s  {fix.stage:10}  {fix.status:8}  {where}")
