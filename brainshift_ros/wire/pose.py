"""Rigid transforms on the wire: PoseStamped and TransformStamped <-> T_patient_tracker."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import rigid
from brainshift_ros.graph import LRS_INITIAL_POSE, REGISTRATION, TRACKER_FRAME, Topic
from brainshift_ros.wire.plain import Plain, check_finite, check_frame, check_reach, expect_frame, header, vector

#: Quaternions travel as float64; a norm further from one than this was not meant as a rotation.
UNIT_TOLERANCE = 1e-3


def decode_pose(message: Any, topic: Topic = LRS_INITIAL_POSE) -> NDArray[np.float64]:
    """T_patient_tracker, shape (4, 4): the pose of the tracker in the patient frame, from a PoseStamped.

    Raises
    ------
    InputError
        Wrong frame, a number that is not finite, a quaternion that is zero or not of unit length, or millimetres.
    """
    check_frame(message, topic)
    return _rigid(message.pose.position, message.pose.orientation, topic)


def encode_pose(T_patient_tracker: NDArray[np.float64], stamp_ns: int) -> Plain:
    """Plain PoseStamped."""
    position, orientation = _parts(T_patient_tracker)
    pose = {"position": position, "orientation": orientation}
    return {"header": header(str(LRS_INITIAL_POSE.frame), stamp_ns), "pose": pose}


def decode_transform(message: Any, topic: Topic = REGISTRATION) -> NDArray[np.float64]:
    """T_patient_tracker, shape (4, 4), from a TransformStamped; errors as :func:`decode_pose`."""
    check_frame(message, topic)
    expect_frame(str(message.child_frame_id), TRACKER_FRAME, topic)
    return _rigid(message.transform.translation, message.transform.rotation, topic)


def encode_transform(T_patient_tracker: NDArray[np.float64], stamp_ns: int) -> Plain:
    """Plain TransformStamped."""
    translation, rotation = _parts(T_patient_tracker)
    return {
        "header": header(str(REGISTRATION.frame), stamp_ns),
        "child_frame_id": TRACKER_FRAME,
        "transform": {"translation": translation, "rotation": rotation},
    }


def _rigid(position: Any, orientation: Any, topic: Topic) -> NDArray[np.float64]:
    translation = check_finite(vector(position), "position", topic)
    quaternion = check_finite([orientation.x, orientation.y, orientation.z, orientation.w], "orientation", topic)
    norm = float(np.linalg.norm(quaternion))
    if norm == 0.0:
        raise InputError(topic.name, "its quaternion is zero", "send a unit quaternion; no rotation is x y z w = 0 0 0 1")
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise InputError(topic.name, f"its quaternion has length {norm:.6g}", "send a unit quaternion")
    check_reach(translation, "position", topic)
    return rigid(Rotation.from_quat(quaternion), translation)


def _parts(T: NDArray[np.float64]) -> tuple[Plain, Plain]:
    translation = {name: float(value) for name, value in zip("xyz", T[:3, 3], strict=True)}
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return translation, {name: float(value) for name, value in zip("xyzw", quaternion, strict=True)}
