"""Poses and points: what a robot, and the importers of recordings, compute with them.

A pose is six numbers (6,), a position in metres and a rotation vector in radians in one frame; that
of a camera is a matrix (4, 4).
An action is a change of the pose, whose rotation is applied after the present one (see `compose`).
Depth is metres along the viewing direction. Nothing of the project is imported.
"""

import math
from collections.abc import Sequence

import numpy as np

# ---- Depth and clouds ----------------------------------------------------------------------------


def is_pose(matrix: np.ndarray) -> bool:
    """Whether a (4, 4) is a pose: a rotation, a translation, and a last row of 0, 0, 0, 1."""
    rotation = matrix[:3, :3]
    orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    return bool(orthogonal and np.linalg.det(rotation) > 0 and matrix[3].tolist() == [0, 0, 0, 1])


def has_depth(depth: np.ndarray) -> np.ndarray:
    """Which pixels of a depth image (H, W) have depth, (H, W) bool."""
    return np.isfinite(depth) & (depth > 0)


def depth_to_points(depth: np.ndarray, intrinsics: Sequence[float]) -> np.ndarray:
    """Depth (H, W), metres -> points (M, 3) float32, camera frame: right, down, forward.

    `intrinsics` are those of the depth image, in pixels: two focal lengths, the principal point.
    """
    fx, fy, cx, cy = intrinsics
    rows, columns = np.nonzero(has_depth(depth))
    z = depth[rows, columns]
    return np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=-1).astype(np.float32)


def transform(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Moves the positions of points (M, P) by a pose (4, 4); returns float32."""
    moved = points.astype(np.float32)  # a copy
    moved[:, :3] = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    return moved


SAMPLED_FROM = 8192  # the most points that are sampled from, which then takes 10 ms


def thin(points: np.ndarray) -> np.ndarray:
    """At most SAMPLED_FROM of the points (M, P): all, or every second, third ..."""
    return points[:: max(1, math.ceil(len(points) / SAMPLED_FROM))]


# ---- Poses and rotation vectors ------------------------------------------------------------------


def quaternion(rotvec: Sequence[float]) -> tuple[float, float, float, float]:
    """The unit quaternion (w, x, y, z) of a rotation vector (3,)."""
    x, y, z = rotvec
    angle = math.sqrt(x * x + y * y + z * z)
    scale = math.sin(angle / 2) / angle if angle > 1e-9 else 0.5
    return math.cos(angle / 2), scale * x, scale * y, scale * z


def rotate(rotvec: Sequence[float], turn: Sequence[float]) -> np.ndarray:
    """The rotation vector (3,) of one rotation, then a further turn; its angle is at most pi.

    In plain numbers, which take a tenth of the time that arrays of three numbers take: the thread
    that streams motion to a robot does this up to nine times in 8 ms, and keeps Python's lock from
    all other threads meanwhile.
    """
    aw, ax, ay, az = quaternion(turn)
    bw, bx, by, bz = quaternion(rotvec)
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + bw * ax + ay * bz - az * by
    y = aw * by + bw * ay + az * bx - ax * bz
    z = aw * bz + bw * az + ax * by - ay * bx
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine if sine > 1e-9 else 2.0, w)
    return np.array([scale * x, scale * y, scale * z])


def compose(pose: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Pose (6,) and relative action (>= 6,) -> the pose (6,) it leads to."""
    rotvec = rotate(pose[3:].tolist(), action[3:6].tolist())
    return np.concatenate([pose[:3] + action[:3], rotvec])


def difference(pose: np.ndarray, later: np.ndarray) -> np.ndarray:
    """The action (6,) that leads from one pose to a later one; the inverse of `compose`."""
    turn = rotate((-pose[3:]).tolist(), later[3:].tolist())
    return np.concatenate([later[:3] - pose[:3], turn])


def other_rotvec(rotvec: np.ndarray) -> np.ndarray:
    """The other vector (3,) of the same rotation, by a - 2 pi where this one is by a.

    No rotation has only one, 0.
    """
    angle = np.linalg.norm(rotvec)
    return rotvec * (1 - 2 * np.pi / angle) if angle > 0 else rotvec


def nearer(rotvec: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Of the two vectors (3,) of one rotation, angles a and a - 2 pi, the nearer to `reference`.

    For a tool that points down, half a turn from the base, a robot's controller jumps between them.
    Where both are as far from `reference`, the result jumps, too.
    """
    return min(rotvec, other_rotvec(rotvec), key=lambda v: np.linalg.norm(v - reference))


def lengths(steps: np.ndarray) -> np.ndarray:
    """Steps (..., 6 or 7) -> metres and radians of each (..., 2)."""
    return np.linalg.norm(np.reshape(steps[..., :6], (*steps.shape[:-1], 2, 3)), axis=-1)


def distance(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far two poses (6,) are apart: metres and radians (2,).

    Poses are compared by this alone. Their six numbers may differ by a whole turn where the poses
    are the same, since a rotation by nearly pi, as of a tool that points down, has two vectors.
    """
    return lengths(difference(pose, other))


def toward(pose: np.ndarray, target: np.ndarray, most: np.ndarray) -> np.ndarray:
    """From pose to target (6,), by no more than (metres, radians): straight, and on SO(3)."""
    step = difference(pose, target)
    shares = np.minimum(1, most / lengths(step).clip(1e-12))  # (2,) of the way, of the turn
    return compose(pose, step * np.repeat(shares, 3))
