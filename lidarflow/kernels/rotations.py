"""Unit quaternions x, y, z, w and cross products as plain numbers, so that they stay in registers."""

import math

from lidarflow.kernels.compiled import FUSED, njit

SERIES_BELOW = 0.01    # squared sine of half an angle, below which the series are exact to rounding


@njit(**FUSED)
def cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(**FUSED)
def turned(qx, qy, qz, qw, x, y, z):
    """The vector x, y, z turned by a quaternion."""
    tx, ty, tz = cross(qx, qy, qz, x, y, z)
    tx, ty, tz = 2.0 * tx, 2.0 * ty, 2.0 * tz
    cx, cy, cz = cross(qx, qy, qz, tx, ty, tz)
    return x + qw * tx + cx, y + qw * ty + cy, z + qw * tz + cz


@njit(**FUSED)
def between(ax, ay, az, aw, bx, by, bz, bw):
    """The quaternion a⁻¹ b, with w ≥ 0."""
    x = aw * bx - ax * bw - (ay * bz - az * by)
    y = aw * by - ay * bw - (az * bx - ax * bz)
    z = aw * bz - az * bw - (ax * by - ay * bx)
    w = aw * bw + ax * bx + ay * by + az * bz
    if w < 0.0:
        return -x, -y, -z, -w
    return x, y, z, w


@njit(**FUSED)
def logarithm(x, y, z, w):
    """Rotation vector ω of a quaternion with w ≥ 0, and c and dc/d|ω|² of the inverse left Jacobian.

    J⁻¹(ω) = I − ½ [ω] + c [ω]², c = (1 − ½|ω| cot ½|ω|) / |ω|².
    """
    sine_sq = x * x + y * y + z * z
    if sine_sq < SERIES_BELOW:
        return logarithm_series(x, y, z)
    sine = math.sqrt(sine_sq)
    half = math.atan2(sine, w)
    scale = 2.0 * half / sine
    angle_sq = 4.0 * half * half
    cot = w / sine
    c = (1.0 - half * cot) / angle_sq
    slope = (-0.25 * (cot / half - 1.0 / sine_sq) - 2.0 * c) / (2.0 * angle_sq)
    return scale * x, scale * y, scale * z, c, slope


@njit(**FUSED)
def logarithm_series(x, y, z):
    """`logarithm` of a quaternion whose squared sine x² + y² + z² is below SERIES_BELOW."""
    s = x * x + y * y + z * z
    scale = 2.0 + s * (1.0 / 3.0 + s * (3.0 / 20.0 + s * (
        5.0 / 56.0 + s * (35.0 / 576.0 + s * (63.0 / 1408.0)))))
    a = scale * scale * s
    c = 1.0 / 12.0 + a * (1.0 / 720.0 + a * (1.0 / 30240.0 + a * (
        1.0 / 1209600.0 + a * (1.0 / 47900160.0))))
    slope = 1.0 / 720.0 + a * (1.0 / 15120.0 + a * (1.0 / 403200.0 + a * (1.0 / 11975040.0)))
    return scale * x, scale * y, scale * z, c, slope


@njit(**FUSED)
def inverse_jacobian(ox, oy, oz, c, sign, x, y, z):
    """J⁻¹(ω) (sign 1) or its transpose (sign −1), the inverse right Jacobian, times a vector."""
    ax, ay, az = cross(ox, oy, oz, x, y, z)
    bx, by, bz = cross(ox, oy, oz, ax, ay, az)
    half = 0.5 * sign
    return x - half * ax + c * bx, y - half * ay + c * by, z - half * az + c * bz


@njit(**FUSED)
def stepped(qx, qy, qz, qw, ox, oy, oz):
    """The unit quaternion q, then a turn by about the rotation vector ω (Cayley's map)."""
    ox, oy, oz = 0.5 * ox, 0.5 * oy, 0.5 * oz
    x = qx + qw * ox + (oy * qz - oz * qy)
    y = qy + qw * oy + (oz * qx - ox * qz)
    z = qz + qw * oz + (ox * qy - oy * qx)
    w = qw - qx * ox - qy * oy - qz * oz
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return scale * x, scale * y, scale * z, scale * w


@njit(**FUSED)
def from_matrix(m):
    """Unit quaternion of a rotation matrix, the first three rows and columns of `m` (Shepperd 1978)."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace > max(m[0, 0], m[1, 1], m[2, 2]):
        x, y, z, w = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace
    elif m[0, 0] >= m[1, 1] and m[0, 0] >= m[2, 2]:
        x, y = 1.0 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0]
        z, w = m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]
    elif m[1, 1] >= m[2, 2]:
        x, y = m[0, 1] + m[1, 0], 1.0 - m[0, 0] + m[1, 1] - m[2, 2]
        z, w = m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]
    else:
        x, y = m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
        z, w = 1.0 - m[0, 0] - m[1, 1] + m[2, 2], m[1, 0] - m[0, 1]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return scale * x, scale * y, scale * z, scale * w


@njit(**FUSED)
def to_matrix(x, y, z, w, matrix):
    """Fill the first three rows and columns of `matrix` with the rotation of a unit quaternion."""
    matrix[0, 0], matrix[1, 1] = 1.0 - 2.0 * (y * y + z * z), 1.0 - 2.0 * (x * x + z * z)
    matrix[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    matrix[0, 1], matrix[1, 0] = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
    matrix[0, 2], matrix[2, 0] = 2.0 * (x * z + y * w), 2.0 * (x * z - y * w)
    matrix[1, 2], matrix[2, 1] = 2.0 * (y * z - x * w), 2.0 * (y * z + x * w)
