"""A ROV that docks by what `lumidock serve` sends over MAVLink alone: video out by RTP, poses and go / no-go in.

usage: python rov.py STATION.yaml CAMERA.yaml VEHICLE.yaml
"""

import math
import subprocess
import sys
import time
from fractions import Fraction

import av
import cv2
import numpy as np
from pymavlink import mavutil

from lumidock import load_camera, load_station
from lumidock.docking.vehicle import ROV, Motion, T_dock_cam_of, body_drag
from lumidock.geometry import se3_inverse, transform_points

VIDEO, MAVLINK, FPS, GOAL_M, MOST_S = 5614, 14614, 15, 3.0 - ROV.half_m[0], 180.0
station, camera = load_station(sys.argv[1]), load_camera(sys.argv[2])
rear = station.layer != station.layers.index(station.layers_front_to_rear()[0])
motion = Motion(ROV, (-8.0, 0.4, -0.3), math.radians(4.0))  # 8 m before the entrance, beside the axis


def picture() -> np.ndarray:
    """What the ROV's camera shows: blurred discs, white in front and blue at the rear."""
    T_dock_cam = T_dock_cam_of(ROV, motion.position, (motion.heading_rad, 0.0, 0.0))
    p_cam = transform_points(se3_inverse(T_dock_cam), station.p_dock)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    for (u, v), p, blue in zip(np.nan_to_num(camera.project(p_cam), nan=-99.0), p_cam, rear, strict=True):
        if p[2] > 0.1 and abs(u) < 5e3 and abs(v) < 5e3:
            radius = round(16 * max(1.2, 0.02 * camera.focal_px[0] / p[2]))
            color = (255, 110, 40) if blue else (235, 235, 235)
            cv2.circle(
                image, (round(16 * u), round(16 * v)), radius, color, -1, cv2.LINE_AA, 4
            )  # sixteenths of a pixel
    noise = cv2.randn(np.empty(image.shape, np.int16), 6, 2)  # without it a ROV at rest repeats its picture: `frozen`
    return np.clip(cv2.GaussianBlur(image, (0, 0), 1.2) + noise, 0, 255).astype(np.uint8)


def limited(value: float, most: float) -> float:
    """The value, within plus and minus `most`."""
    return max(-most, min(most, value))


link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{MAVLINK}")
command = [sys.executable, "-m", "lumidock", "serve", f"rtp://127.0.0.1:{VIDEO}", "--mavlink", f"127.0.0.1:{MAVLINK}"]
command += ["--station", sys.argv[1], "--camera", sys.argv[2], "--vehicle", sys.argv[3]]
server = subprocess.Popen([*command, "--go-no-go", f"{ROV.radius_m}:0.05", "--health-port", "0"])
video = av.open(f"rtp://127.0.0.1:{VIDEO}", "w", format="rtp")
coding = {"tune": "zerolatency", "preset": "ultrafast", "g": "8", "crf": "16"}
stream = video.add_stream("libx264", rate=FPS, options=coding)
stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
stream.codec_context.time_base = Fraction(1, 90_000)
place, course, go, begun, now, said = None, motion.heading_rad, 1, time.monotonic(), time.monotonic(), set()
while now - begun < MOST_S and server.poll() is None:
    frame = av.VideoFrame.from_ndarray(picture(), "bgr24")
    frame.pts, frame.time_base = int((now - begun) * 90_000), Fraction(1, 90_000)
    video.mux(stream.encode(frame))
    until, answered = time.monotonic() + 1.0, False  # of this frame: a slow machine costs frames, not control
    while message := link.recv_match(blocking=not answered, timeout=max(0.01, until - time.monotonic())):
        if message.get_type() == "VISION_POSITION_ESTIMATE":  # forward, right, down
            place, course = [message.x, message.y, message.z], motion.heading_rad + message.yaw
        elif message.get_type() == "NAMED_VALUE_INT" and message.name == "go_no_go":
            go, answered = message.value, True
        elif message.get_type() == "STATUSTEXT" and message.text not in said:
            said.add(message.text)
            print(f"{now - begun:6.1f} s  {message.text}", flush=True)
    (surge, sway, heave), wanted = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if place is not None:
        ahead = {2: limited(0.5 * (GOAL_M - place[0]), 0.5), 1: 0.0, 0: -0.3}[go]  # go, hold, abort
        wanted = (ahead, limited(-0.5 * place[1], 0.2), limited(-0.5 * place[2], 0.2))
        surge, sway, heave = (body_drag(ROV, axis, sign * wanted[axis]) for axis, sign in enumerate((1.0, -1.0, -1.0)))
        if go == 2 and abs(GOAL_M - place[0]) < 0.1:
            break
    time.sleep(max(0.0, now + 1.0 / FPS - time.monotonic()))
    lapse, now = time.monotonic() - now, time.monotonic()
    place = place and [at + w * lapse for at, w in zip(place, wanted, strict=True)]  # reckoned until the next message
    for _ in range(max(1, round(lapse / 0.02))):
        yaw = 4.0 * (course - motion.heading_rad) - 3.0 * motion.through_water[3]  # the autopilot's own heading hold
        motion.step((surge, sway, heave, yaw), (0.0, 0.0, 0.0), lapse / max(1, round(lapse / 0.02)))
server.terminate()
server.wait()
miss = math.dist(motion.position, (GOAL_M, 0.0, 0.0))
print(f"{now - begun:6.1f} s  at {np.round(motion.position, 2).tolist()}, {miss:.2f} m from the docking point")
sys.exit(0 if miss < 0.15 else 1)
