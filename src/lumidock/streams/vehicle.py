"""How the camera is mounted on the vehicle, and what the frames are called there: vehicle files (schema 1).

schema: 1
body_frame: base_link                    # x forward, y left, z up (REP-103)
camera_frame: camera_optical             # x right, y down, z forward
T_body_cam: {translation: [0.8, 0.0, 0.1], quat_xyzw: [-0.5, 0.5, -0.5, 0.5]}   # looks straight ahead
transform: camera_to_dock                # parent and child on /tf; or dock_to_camera, or none
mounting_transform: false                # true: T_body_cam on /tf_static too, where no robot description has it
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lumidock.datatypes import Array, require_shape
from lumidock.errors import InputError
from lumidock.geometry import pose_from_quat
from lumidock.yamlfile import read_mapping, validate

_UNIT_TOLERANCE = 1e-3  # a quaternion further from unit length than rounding explains is a slip of the pen
TransformWay = Literal["camera_to_dock", "dock_to_camera", "none"]
_FrameName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_/]{0,63}$")]


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """Mounting `T_body_cam` (4, 4), the pose of cam in body, the names of the frames, and what ROS is told of them.

    `transform` says which of dock and camera is the parent on /tf. A robot with a description (URDF) has a parent for
    its camera already, so that the dock has to be the child, and the mounting must not be told twice.
    """

    T_body_cam: Array
    dock_frame: str = "dock"
    camera_frame: str = "camera_optical"
    body_frame: str = "base_link"
    transform: TransformWay = "camera_to_dock"
    mounting_transform: bool = False

    def __post_init__(self) -> None:
        require_shape("T_body_cam", self.T_body_cam, 4, 4)


class _Mounting(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    translation: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


class _VehicleFile(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    schema_: Annotated[Literal[1], Field(alias="schema")]
    dock_frame: _FrameName = "dock"
    camera_frame: _FrameName = "camera_optical"
    body_frame: _FrameName = "base_link"
    T_body_cam: _Mounting
    transform: TransformWay = "camera_to_dock"
    mounting_transform: bool = False


def load_vehicle(path: Path) -> Vehicle:
    """Read a vehicle file. Raises: InputError, one line, for anything the schema refuses."""
    content = validate(_VehicleFile, read_mapping(path, "vehicle"), str(path))
    frames = content.dock_frame, content.camera_frame, content.body_frame
    if len(set(frames)) != len(frames):
        raise InputError(f"{path}: dock_frame, camera_frame and body_frame have to differ")
    quat_xyzw = np.array(content.T_body_cam.quat_xyzw)
    if abs(np.linalg.norm(quat_xyzw) - 1.0) > _UNIT_TOLERANCE:
        raise InputError(f"{path}: T_body_cam.quat_xyzw: not of unit length")
    T_body_cam = pose_from_quat(np.array(content.T_body_cam.translation), quat_xyzw)
    return Vehicle(T_body_cam, *frames, transform=content.transform, mounting_transform=content.mounting_transform)
