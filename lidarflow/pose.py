"""Rigid motions as (..., 4, 4) arrays; the only home of rotation and quaternion arithmetic.

`a_from_b` maps coordinates in frame b to coordinates in frame a. A twist is (rotation, translation) in
radians and metres, as in gtsam. A quaternion is x, y, z, w.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

_SMALL_ANGLE = 1e-4
_BLOCK = 4096    # rows of one product; of very many, BLAS starts threads that go on spinning when it is done


def identity(*shape: int) -> np.ndarray:
    """Identity motions (*shape, 4, 4)."""
    return np.tile(np.eye(4), (*shape, 1, 1))


def from_rotation_translation(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Motions (..., 4, 4) from rotation matrices (..., 3, 3) and translations (..., 3) in metres."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    motion = identity(*shape)
    motion[..., :3, :3] = rotation
    motion[..., :3, 3] = translation
    return motion


def from_translation(translation: np.ndarray) -> np.ndarray:
    """Pure translations (..., 4, 4) from vectors (..., 3) in metres."""
    return from_rotation_translation(np.eye(3), translation)


def from_yaw(yaw: float, translation: np.ndarray | Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Motion (4, 4) that turns about z by `yaw` radians, then moves by `translation` metres."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, y, z = translation
    return np.array([
        [cosine, -sine, 0.0, x], [sine, cosine, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def inverse(motion: np.ndarray) -> np.ndarray:
    """Inverse motions (..., 4, 4)."""
    rotation = np.swapaxes(motion[..., :3, :3], -1, -2)
    return from_rotation_translation(rotation, -(rotation @ motion[..., :3, 3:])[..., 0])


def apply(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) in metres moved by motions (..., 4, 4); the leading shapes broadcast."""
    if motion.ndim == 2:
        return _turned_and_shifted(motion, points, motion[:3, 3])
    return np.einsum("...ij,...j->...i", motion[..., :3, :3], points) + motion[..., :3, 3]


def turn(motion: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3), such as velocities, in the axes that a motion (4, 4) leads to; nothing is shifted."""
    return _turned_and_shifted(motion, vectors, np.zeros(3))


def _turned_and_shifted(motion: np.ndarray, vectors: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned by one motion (4, 4), then shifted (3,)."""
    rows, turned = vectors.reshape(-1, 3), np.ascontiguousarray(motion[:3, :3].T)
    moved = np.empty((len(rows), 3))
    shifts = np.empty((min(len(rows), _BLOCK), 3))
    shifts[:] = shift       # row by row: numpy takes longer to add three numbers to many rows
    for start in range(0, len(rows), _BLOCK):
        block = moved[start: start + _BLOCK]
        np.matmul(rows[start: start + _BLOCK], turned, out=block)
        block += shifts[:len(block)]
    return moved.reshape(vectors.shape)


def aligned(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Motions (..., 4, 4) of points (..., K, 3) onto (..., K, 3) by least squares (Kabsch 1976)."""
    from_mean, to_mean = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    left, _, right = np.linalg.svd(np.swapaxes(target - to_mean, -1, -2) @ (source - from_mean))
    # A mirror image is no rotation: the least certain axis is turned back.
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    rotation = left @ right
    shift = to_mean[..., 0, :] - (rotation @ from_mean[..., 0, :, None])[..., 0]
    return from_rotation_translation(rotation, shift)


def hat(vector: np.ndarray) -> np.ndarray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    vector = np.asarray(vector, float)
    matrix = np.zeros((*vector.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -vector[..., 2], vector[..., 1], -vector[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def _left_jacobian(rotation_vector: np.ndarray) -> np.ndarray:
    """Left Jacobian of SO(3), (..., 3, 3): it turns a twist's translation into a motion's."""
    angle = np.linalg.norm(rotation_vector, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    cross = hat(rotation_vector)
    return np.eye(3) + a * cross + b * (cross @ cross)


def exp(twist: np.ndarray) -> np.ndarray:
    """Motions (..., 4, 4) of twists (..., 6), rotation first."""
    twist = np.asarray(twist, float)
    rotation_vector, translation = twist[..., :3], twist[..., 3:]
    rotation = Rotation.from_rotvec(rotation_vector.reshape(-1, 3)).as_matrix()
    moved = (_left_jacobian(rotation_vector) @ translation[..., None])[..., 0]
    return from_rotation_translation(rotation.reshape(*twist.shape[:-1], 3, 3), moved)


def log(motion: np.ndarray) -> np.ndarray:
    """Twists (..., 6), rotation first, of motions (..., 4, 4)."""
    motion = np.asarray(motion, float)
    rotation_vector = Rotation.from_matrix(motion[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    rotation_vector = rotation_vector.reshape(*motion.shape[:-2], 3)
    translation = np.linalg.solve(_left_jacobian(rotation_vector), motion[..., :3, 3:])[..., 0]
    return np.concatenate([rotation_vector, translation], axis=-1)


def adjoint(motion: np.ndarray) -> np.ndarray:
    """Adjoint matrices (..., 6, 6): Log(T exp(ξ) T⁻¹) = Ad(T) ξ, rotation first."""
    rotation = motion[..., :3, :3]
    matrix = np.zeros((*motion.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = rotation
    matrix[..., 3:, :3] = hat(motion[..., :3, 3]) @ rotation
    return matrix


def interpolate(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Motion at `share` of the screw path from `start` (0) to `end` (1), shapes (..., 4, 4)."""
    return start @ exp(share * log(inverse(start) @ end))


def lasting(motion: np.ndarray, took: float, dt: float) -> np.ndarray:
    """Motions (..., 4, 4) that took as long as `took`, gone on with for `dt` in the same unit."""
    # Equal times must not let rounding in.
    return motion if took == dt else interpolate(np.eye(4), motion, dt / took)


def trajectory(steps: np.ndarray) -> np.ndarray:
    """Poses (N + 1, 4, 4), first_from_each, of a sensor whose `steps` (N, 4, 4) are target_from_source."""
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ inverse(step))
    return np.stack(poses)


def translation_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance in metres (...) between the origins of motions (..., 4, 4)."""
    return np.linalg.norm((inverse(a) @ b)[..., :3, 3], axis=-1)


def rotation_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle in radians (...) between the rotations of motions (..., 4, 4)."""
    relative = np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3]
    return Rotation.from_matrix(relative.reshape(-1, 3, 3)).magnitude().reshape(relative.shape[:-2])


def to_translation_quaternion(motion: np.ndarray) -> np.ndarray:
    """Rows (..., 7) tx ty tz qx qy qz qw of motions (..., 4, 4), with qw ≥ 0."""
    rotation = Rotation.from_matrix(motion[..., :3, :3].reshape(-1, 3, 3))
    quaternion = rotation.as_quat(canonical=True).reshape(*motion.shape[:-2], 4)
    return np.concatenate([motion[..., :3, 3], quaternion], axis=-1)


def from_translation_quaternion(rows: np.ndarray) -> np.ndarray:
    """Motions (..., 4, 4) of rows (..., 7) tx ty tz qx qy qz qw."""
    rows = np.asarray(rows, float)
    rotation = Rotation.from_quat(rows[..., 3:].reshape(-1, 4)).as_matrix()
    return from_rotation_translation(rotation.reshape(*rows.shape[:-1], 3, 3), rows[..., :3])


def yaw_quaternion(yaw: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of turns about z by `yaw` (...) radians."""
    half = np.asarray(yaw, float) / 2.0
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def is_rigid(motion: np.ndarray, tolerance: float = 1e-6) -> bool:
    """Whether every motion (..., 4, 4) is finite, orthonormal and right-handed, with a last row 0 0 0 1."""
    if motion.shape[-2:] != (4, 4) or not np.isfinite(motion).all():
        return False
    rotation = motion[..., :3, :3]
    orthonormal = np.allclose(rotation @ np.swapaxes(rotation, -1, -2), np.eye(3), atol=tolerance)
    right_handed = bool((np.linalg.det(rotation) > 0).all())
    return orthonormal and right_handed and np.allclose(motion[..., 3, :], [0, 0, 0, 1], atol=tolerance)
