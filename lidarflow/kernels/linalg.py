"""Small dense linear algebra that compiles to straight-line code."""

import math

import numpy as np

from lidarflow.kernels.compiled import njit

_RISE = 2.0 / math.sqrt(3.0)    # of the least root of t³ - 3 t = 2 - 4 u², as u leaves 0
_NO_SLOPE = 1e-30               # where two roots meet


@njit()
def symmetric_eigen3(a00, a01, a02, a11, a12, a22, values, vectors):
    """Eigenvalues (3,) ascending and unit eigenvectors (3, 3) as columns, by cyclic Jacobi rotations."""
    m = np.empty((3, 3))
    m[0, 0], m[0, 1], m[0, 2] = a00, a01, a02
    m[1, 0], m[1, 1], m[1, 2] = a01, a11, a12
    m[2, 0], m[2, 1], m[2, 2] = a02, a12, a22
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    scale = a00 * a00 + a11 * a11 + a22 * a22
    for _ in range(12):
        if m[0, 1] ** 2 + m[0, 2] ** 2 + m[1, 2] ** 2 <= 1e-28 * scale:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if m[p, q] == 0.0:
                    continue
                theta = (m[q, q] - m[p, p]) / (2.0 * m[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    mkp, mkq = m[k, p], m[k, q]
                    m[k, p], m[k, q] = c * mkp - s * mkq, s * mkp + c * mkq
                for k in range(3):
                    mpk, mqk = m[p, k], m[q, k]
                    m[p, k], m[q, k] = c * mpk - s * mqk, s * mpk + c * mqk
                for k in range(3):
                    vkp, vkq = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * vkp - s * vkq, s * vkp + c * vkq
    for i in range(3):
        values[i] = m[i, i]
    for i in range(2):
        for j in range(2 - i):
            if values[j] > values[j + 1]:
                values[j], values[j + 1] = values[j + 1], values[j]
                for k in range(3):
                    vectors[k, j], vectors[k, j + 1] = vectors[k, j + 1], vectors[k, j]


@njit()
def plane_eigen3(a00, a01, a02, a11, a12, a22, values, normal):
    """Eigenvalues (3,) ascending, and the unit eigenvector (3,) of the least (after Smith 1961).

    Less their mean and over their spread, eigenvalues are the roots of t³ - 3 t = d, where d is a
    determinant; Newton's steps to the least one take less than its cosine. As good as rotations where the
    least is apart from the others; where it is not, no direction means much.
    """
    mean = (a00 + a11 + a22) / 3.0
    b00, b11, b22 = a00 - mean, a11 - mean, a22 - mean
    spread = math.sqrt((b00 * b00 + b11 * b11 + b22 * b22 + 2.0 * (a01 * a01 + a02 * a02 + a12 * a12)) / 6.0)
    values[0] = values[1] = values[2] = mean
    normal[0], normal[1], normal[2] = 1.0, 0.0, 0.0
    if spread == 0.0:
        return
    half_det = 0.5 * (b00 * (b11 * b22 - a12 * a12) - a01 * (a01 * b22 - a12 * a02)
                      + a02 * (a01 * a12 - b11 * a02)) / (spread * spread * spread)
    half_det = min(max(half_det, -1.0), 1.0)
    u = math.sqrt(0.5 - 0.5 * half_det)
    t = -1.0 - (_RISE - (_RISE - 1.0) * u) * u     # right where u is 0 or 1, and how it begins
    for _ in range(3):
        t -= (t * t * t - 3.0 * t - 2.0 * half_det) / max(3.0 * t * t - 3.0, _NO_SLOPE)
    values[0] = mean + spread * t
    values[2] = mean + 0.5 * spread * (math.sqrt(max(12.0 - 3.0 * t * t, 0.0)) - t)
    values[1] = 3.0 * mean - values[0] - values[2]
    # It is across all rows of A - λ I; the two that are least alike tell it best.
    c00, c11, c22 = a00 - values[0], a11 - values[0], a22 - values[0]
    longest_sq = 0.0
    for pair in range(3):
        if pair == 0:
            x, y, z = a01 * a12 - a02 * c11, a02 * a01 - c00 * a12, c00 * c11 - a01 * a01
        elif pair == 1:
            x, y, z = a01 * c22 - a02 * a12, a02 * a02 - c00 * c22, c00 * a12 - a01 * a02
        else:
            x, y, z = c11 * c22 - a12 * a12, a12 * a02 - a01 * c22, a01 * a12 - c11 * a02
        length_sq = x * x + y * y + z * z
        if length_sq > longest_sq:
            longest_sq = length_sq
            length = math.sqrt(length_sq)
            normal[0], normal[1], normal[2] = x / length, y / length, z / length


@njit(inline="always")
def moved(point, motion):
    """Where a motion (3, 4) or (4, 4) takes a point (3,): x, y, z in metres."""
    x, y, z = point[0], point[1], point[2]
    return (motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3],
            motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3],
            motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3])


@njit(inline="always")
def turned(vector, motion):
    """Where the rotation of a motion (3, 4) or (4, 4) takes a direction (3,): x, y, z."""
    x, y, z = vector[0], vector[1], vector[2]
    return (motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z,
            motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z,
            motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z)


@njit()
def solve_positive6(matrix, right):
    """Solve matrix x = right, positive definite (6, 6); x replaces right (6,), and matrix is overwritten."""
    _solve_positive(matrix, right, 6)


@njit()
def solve_positive3(matrix, right):
    """Solve matrix x = right, positive definite (3, 3); x replaces right (3,), and matrix is overwritten."""
    _solve_positive(matrix, right, 3)


@njit()
def solve_positive4(matrix, right):
    """Solve matrix x = right, positive definite (4, 4); x replaces right (4,), and matrix is overwritten."""
    _solve_positive(matrix, right, 4)


@njit(inline="always")
def _solve_positive(matrix, right, size):
    """By Cholesky's factors."""
    for j in range(size):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = math.sqrt(matrix[j, j])
        for i in range(j + 1, size):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]
    for i in range(size):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]
