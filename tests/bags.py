"""Bags for the tests, written by the library rosbags: pictures, and the camera they were taken with."""

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
KINDS = ("mcap", "db3", "bag")


def header(store, t_ns, number=0, frame_id="cam_optical"):
    time = store.types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
    more = {"seq": number} if "seq" in store.types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **more)


def raw(t_ns, pixels, encoding, *, padding=0, big=False):
    """An Image message as a function of the store."""

    def make(store):
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        data = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        height, width = pixels.shape[:2]
        return store.types["sensor_msgs/msg/Image"](
            header(store, t_ns), height, width, encoding, int(big), data.shape[1], data.reshape(-1)
        )

    return make


def compressed(t_ns, data, form="png"):
    def make(store):
        return store.types["sensor_msgs/msg/CompressedImage"](header(store, t_ns), form, np.frombuffer(data, np.uint8))

    return make


def info(t_ns, camera, model=None, *, frame_id="cam_optical", roi=(0, 0, 0, 0), **changes):
    """A CameraInfo message as a function of the store; `changes` are its fields under their ROS 2 names."""

    def make(store):
        Info, Roi = (store.types[f"sensor_msgs/msg/{name}"] for name in ("CameraInfo", "RegionOfInterest"))
        K = np.asarray(camera.K, float)
        P = np.hstack([K, np.zeros((3, 1))]).reshape(-1)
        fields = {"d": np.asarray(camera.distortion, float), "k": K.reshape(-1), "r": np.eye(3).reshape(-1), "p": P}
        fields |= {"binning_x": 0, "binning_y": 0, "height": camera.height, "width": camera.width} | changes
        numbers = [np.asarray(fields[name], float) for name in "dkrp"]
        x, y, width, height = roi
        stamp, window = header(store, t_ns, frame_id=frame_id), Roi(x, y, height, width, False)
        size, binning = (fields["height"], fields["width"]), (fields["binning_x"], fields["binning_y"])
        return Info(stamp, *size, model or camera.model, *numbers, *binning, window)

    return make


def write(path, kind, messages, *, compression=None):
    """Write (topic, log time ns, maker of a message) into a bag; returns the path that a person would give."""
    store = STORES[1 if kind == "bag" else 2]
    writer, connections = _writer(path, kind, compression), {}
    with writer:
        for topic, t_ns, make in messages:
            message = make(store)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
            writer.write(connections[topic], t_ns, serialize(message, message.__msgtype__))
    return path if kind != "bag" else path.with_suffix(".bag")


def _writer(path, kind, compression):
    if kind == "bag":
        writer = Writer1(path.with_suffix(".bag"))
        if compression:
            writer.set_compression(getattr(Writer1.CompressionFormat, compression.upper()))
        return writer
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    return writer
