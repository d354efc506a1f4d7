"""Write or read a ROS 1 bag with Debian's own rosbag, under the system's Python. Usage: rosbag1.py write|read FILE"""

import sys

import rosbag
import rospy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image


def stamped(message, number):
    message.header.stamp = rospy.Time(1_700_000_000 + number, 250)
    return message


def write(path, compression):
    with rosbag.Bag(path, "w", compression=compression) as bag:
        for number in range(5):
            raw = stamped(Image(height=4, width=6, encoding="mono8", step=6), number)
            raw.data = bytes((number * 40 + i) % 256 for i in range(24))
            bag.write("/cam/image_raw", raw, rospy.Time(1_700_000_000 + number, 900))
            info = stamped(CameraInfo(height=4, width=6, distortion_model="plumb_bob"), number)
            info.K, info.D = [5.0, 0, 2.5, 0, 5.5, 1.5, 0, 0, 1], [0.1, 0, 0, 0, 0.01]
            bag.write("/cam/camera_info", info, rospy.Time(1_700_000_000 + number, 901))
            bag.write("/cam/thumb/compressed", stamped(CompressedImage(format="png"), number))


def read(path):
    with rosbag.Bag(path) as bag:
        for topic, message, time in bag.read_messages():
            print(topic, message._type, message.header.stamp.to_nsec(), time.to_nsec())


if __name__ == "__main__":
    write(sys.argv[2], sys.argv[3]) if sys.argv[1] == "write" else read(sys.argv[2])
