"""The run folder: fixes, lights, layers, alternatives, trajectory, run.json; whole rows whenever a run is killed."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from typing_extensions import Self

from lumidock.datatypes import Array, Fix, Protection, Velocity
from lumidock.errors import InputError
from lumidock.geometry import bearing_and_range, quat_xyzw_from_rotation

COVARIANCE_COLUMNS = tuple(f"c{i}{j}" for i in range(6) for j in range(i, 6))
PROTECTION_COLUMNS = ("pl_lateral_m", "pl_axial_m", "pl_angle_rad")
GUIDE_COLUMNS = ("bearing_x_rad", "bearing_y_rad", "range_m", "pl_bearing_rad", "pl_range_m")
VELOCITY_COLUMNS = (
    *("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s"),
    *("sigma_vx_m_s", "sigma_vy_m_s", "sigma_vz_m_s", "sigma_wx_rad_s", "sigma_wy_rad_s", "sigma_wz_rad_s"),
)
FIX_COLUMNS = (
    *("frame", "t_ns", "valid", "guide", "status", "stage", "n_seen", "n_used"),
    *("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *COVARIANCE_COLUMNS,
    *PROTECTION_COLUMNS,
    *GUIDE_COLUMNS,
    *("reason", "latency_us"),
    *VELOCITY_COLUMNS,
    "aiding",
)
LIGHT_COLUMNS = ("frame", "u_px", "v_px", "radius_px", "flux", "p_light", "p_rear", "light")
LAYER_COLUMNS = ("frame", "layer", "n_used", "matched_by", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
ALTERNATIVE_COLUMNS = ("frame", "rank", "probability", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_FILES = ("fixes.csv", "lights.csv", "layers.csv", "alternatives.csv", "trajectory.tum", "run.json")
_MOST_HASHED = 1 << 24  # bytes; of a larger file only samples are
_SAMPLES, _SAMPLE = 64, 1 << 16


class RunFolder:
    """Writes a run, each frame's rows in one piece; use as a context manager."""

    def __init__(self, folder: Path, light_ids: tuple[str, ...]) -> None:
        """Start the run's files in `folder`, replacing those of an earlier run.

        Raises: InputError where another process is still writing to it.
        """
        self.folder, self.light_ids = folder, light_ids
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(folder)
        for name in _FILES:
            (folder / name).unlink(missing_ok=True)
        # unbuffered: a row is in the file, whole, or it is not
        self._files = {name: (folder / name).open("wb", buffering=0) for name in _FILES[:5]}
        self._write("fixes.csv", [FIX_COLUMNS])
        self._write("lights.csv", [LIGHT_COLUMNS])
        self._write("layers.csv", [LAYER_COLUMNS])
        self._write("alternatives.csv", [ALTERNATIVE_COLUMNS])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in self._files.values():
            file.close()
        if self._lock is not None:
            os.close(self._lock)

    def add(self, fix: Fix, latency_us: int | None, *, t_ns: int | None) -> None:
        """Append one frame; `t_ns` is None, and its field empty, when the stamp could not be read."""
        self._write("fixes.csv", [_fix_row(fix, latency_us, t_ns)])
        self._write("lights.csv", self._light_rows(fix))
        self._write(
            "layers.csv",
            ([fix.frame, p.layer, p.n_used, p.source, *_pose_fields(p.T_dock_cam)] for p in fix.by_layer),
        )
        self._write(
            "alternatives.csv",
            (
                [fix.frame, rank, _short(one.probability), *_pose_fields(one.T_dock_cam)]
                for rank, one in enumerate(fix.alternatives, start=1)
            ),
        )
        if fix.T_dock_cam is not None:
            line = " ".join([_seconds(fix.t_ns), *_pose_fields(fix.T_dock_cam)])
            self._append("trajectory.tum", f"{line}\n")

    def describe(self, content: dict[str, Any]) -> None:
        """Write run.json, all of it or none."""
        temporary = self.folder / "run.json.part"
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        os.replace(temporary, self.folder / "run.json")

    def _write(self, name: str, rows: Iterable[Iterable[object]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        self._append(name, text.getvalue())

    def _append(self, name: str, text: str) -> None:
        """Write all of `text` or, on a full disk, nothing."""
        file, content = self._files[name], text.encode("utf-8", "backslashreplace")  # a file's name need not be UTF-8
        end = file.tell()
        try:
            while content:  # one write, unless the disk takes only a part
                content = content[file.write(content) :]
        except OSError as error:
            file.truncate(end)
            raise OSError(error.errno, error.strerror, str(self.folder / name)) from None

    def _light_rows(self, fix: Fix) -> Iterable[list[object]]:
        if fix.match is None:
            return
        d = fix.match.detections
        for i, light in enumerate(fix.match.light):
            numbers = (*d.uv[i], d.radius_px[i], d.flux[i], d.p_light[i], d.p_rear[i])
            yield [fix.frame, *map(_number, numbers), self.light_ids[light] if light >= 0 else ""]


def _locked(folder: Path) -> int | None:
    """A lock on a folder, which the system gives up when this process ends; None where the file system has no locks.

    Raises: InputError where another process has it.
    """
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(held)
        raise InputError(
            f"{folder}: another process is writing a run there; write elsewhere, or end it first"
        ) from None
    except OSError:
        os.close(held)
        return None
    return held


def _fix_row(fix: Fix, latency_us: int | None, t_ns: int | None) -> list[object]:
    return [
        fix.frame,
        "" if t_ns is None else t_ns,
        int(fix.valid),
        int(fix.guide is not None),
        fix.status,
        fix.stage,
        fix.n_seen,
        fix.n_used,
        *([""] * 7 if fix.T_dock_cam is None else _pose_fields(fix.T_dock_cam)),
        *_covariance_fields(fix.covariance),
        *_protection_fields(fix.protection),
        *_guide_fields(fix),
        fix.reason,
        "" if latency_us is None else latency_us,
        *_velocity_fields(fix.velocity),
        " ".join(map(str, fix.aiding)),
    ]


def _velocity_fields(velocity: Velocity | None) -> list[str]:
    if velocity is None:
        return [""] * len(VELOCITY_COLUMNS)
    return [_short(value, 6) for value in (*velocity.linear_m_s, *velocity.angular_rad_s, *velocity.sigma)]


def _covariance_fields(covariance: Array | None) -> list[str]:
    """The upper triangle row by row, in 12 digits: lateral and tilt errors of a far plane are nearly proportional."""
    if covariance is None:
        return [""] * len(COVARIANCE_COLUMNS)
    return [_short(value, 12) for value in covariance[np.triu_indices(6)]]


def _protection_fields(protection: Protection | None) -> list[str]:
    if protection is None:
        return [""] * len(PROTECTION_COLUMNS)
    return [_short(value) for value in (protection.lateral_m, protection.axial_m, protection.angle_rad)]


def _guide_fields(fix: Fix) -> list[str]:
    """Bearings and range, of the pose where the method gives no guide, and their protection levels."""
    guide = fix.guide
    if guide is not None:
        bearing = (guide.bearing_x_rad, guide.bearing_y_rad, guide.range_m)
        return [*(f"{value:.9f}" for value in bearing), _short(guide.pl_bearing_rad), _short(guide.pl_range_m)]
    if fix.T_dock_cam is not None:
        return [*(f"{value:.9f}" for value in bearing_and_range(fix.T_dock_cam)), "", ""]
    return [""] * len(GUIDE_COLUMNS)


def _pose_fields(T_dock_cam: Array) -> list[str]:
    return [f"{value:.9f}" for value in (*T_dock_cam[:3, 3], *quat_xyzw_from_rotation(T_dock_cam[:3, :3]))]


def _number(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


def _short(value: float, digits: int = 9) -> str:
    return f"{value:.{digits}g}" if np.isfinite(value) else ""


def _seconds(t_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    whole, part = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{whole}.{part:09d}"


def identities(files: Mapping[str, Path]) -> dict[str, dict[str, Any]]:
    """Hashes that identify the inputs of a run, for run.json: `inputs_sha256` of whole files.

    Of a file over 16 MiB, a recording of perhaps many GB, `inputs_sampled`: its size and the hash of 64 blocks spread
    over it, the first and the last among them. It tells recordings apart, and does not prove that two are identical.
    """
    whole, sampled = dict[str, Any](), dict[str, Any]()
    for name, path in files.items():
        size = path.stat().st_size
        if size > _MOST_HASHED:
            sampled[name] = {"bytes": size, "sha256_of_samples": sha256_of_samples(path, size)}
        else:
            whole[name] = sha256(path)
    return {"inputs_sha256": whole, "inputs_sampled": sampled}


def sha256(path: Path) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()  # at most _MOST_HASHED bytes


def sha256_of_samples(path: Path, size: int) -> str:
    """Hash of 64 blocks of 64 KiB, evenly spread from the first to the last, of a file that is larger than them."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for number in range(_SAMPLES):
            file.seek((size - _SAMPLE) * number // (_SAMPLES - 1))
            digest.update(file.read(_SAMPLE))
    return digest.hexdigest()
