"""Direct alignment of RGB-D images: linearised residuals of a warp, and robust least squares over them.

An equation is a column of seven numbers: six derivatives by a twist of the motion (rotation first, applied
after it), then the residual. A system (chunks, 2, 7, CHUNK) float32 has chunk after chunk of pixels, their
equations of intensity, then those of depth. Chunks have a fixed size, and their sums are added in order: the
number of threads changes nothing.

Packed images are those of images.py. `points` (H, W, 3) are those of the source's pixels, `camera` (4,) is
fx, fy, cx, cy, a motion is (3, 4) target_from_source; all float32, lengths in metres.
"""

import math

import numba
import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import moved, solve_positive6

CHUNK = 1040             # pixels; with a power of two all rows of a chunk would share lines of the cache
NEAREST_M = 0.01         # points this near to the camera, or behind it, are not seen
_SUMS = 28               # 21 of the upper triangle of JᵀWJ, 6 of JᵀWr, 1 of rᵀWr
_SMALLEST_MEAN = 1e-5    # keeps the robust scale positive where everything fits perfectly


@njit(inline="always", error_model="numpy")
def look_up(target, camera, x, y, z, max_jump_m, layers, seen):
    """Fill `seen` with the first `layers` of a packed image where it sees x, y, z; False if it has no depth.

    That is outside the image, or where one of the four pixels around has none. Bilinear, but the nearest
    pixel alone where the four depths differ by more than `max_jump_m`.
    """
    rows, columns = target.shape[0], target.shape[1]
    if z <= NEAREST_M:
        return False
    one = np.float32(1.0)
    by_z = one / z
    u, v = camera[0] * x * by_z + camera[2], camera[1] * y * by_z + camera[3]
    if not (u >= 0.0 and v >= 0.0 and u <= columns - 1 and v <= rows - 1):
        return False
    left, top = min(int(u), columns - 2), min(int(v), rows - 2)
    share_u, share_v = u - np.float32(left), v - np.float32(top)
    above, below = target[top], target[top + 1]
    z00, z01, z10, z11 = above[left, 1], above[left + 1, 1], below[left, 1], below[left + 1, 1]
    nearest, farthest = min(min(z00, z01), min(z10, z11)), max(max(z00, z01), max(z10, z11))
    if nearest <= 0.0:
        return False
    if farthest - nearest > max_jump_m:
        share_u = one if share_u >= 0.5 else np.float32(0.0)
        share_v = one if share_v >= 0.5 else np.float32(0.0)
    w00, w01 = (one - share_u) * (one - share_v), share_u * (one - share_v)
    w10, w11 = (one - share_u) * share_v, share_u * share_v
    for k in range(layers):
        seen[k] = (w00 * above[left, k] + w01 * above[left + 1, k]
                   + w10 * below[left, k] + w11 * below[left + 1, k])
    return True


@njit(error_model="numpy")
def seen_again(points, target, camera, motion):
    """Share of the points with depth that, moved, a packed image has depth for, in the nearest pixel."""
    rows, columns = target.shape[0], target.shape[1]
    known, seen = 0, 0
    half = np.float32(0.5)
    for point in points.reshape(-1, 3):
        if point[2] <= 0.0:
            continue
        known += 1
        x, y, z = moved(point, motion)
        if z <= NEAREST_M:
            continue
        u, v = camera[0] * x / z + camera[2] + half, camera[1] * y / z + camera[3] + half
        if u >= 0.0 and v >= 0.0 and u < columns and v < rows and target[int(v), int(u), 1] > 0.0:
            seen += 1
    return seen / known


@njit(error_model="numpy")
def _fill(points, source, target, camera, motion, pixels, weights, noise, weighting, max_jump_m, equations,
          largest):
    """Write the equations (2, 7, CHUNK) of some pixels, weighted, and return for how many there are any.

    The gradients are the means of those of either image: that linearisation is good to second order.
    `largest` (2,) becomes the largest weights of intensity and of depth.
    """
    seen = np.empty(6, np.float32)
    by_intensity, by_depth = equations[0], equations[1]
    half = np.float32(0.5)
    fx, fy = camera[0], camera[1]
    count = 0
    for i in range(len(pixels)):
        x, y, z = moved(points[pixels[i]], motion)
        if not look_up(target, camera, x, y, z, max_jump_m, 6, seen):
            continue
        here = source[pixels[i]]
        by_z = np.float32(1.0) / z
        r_intensity, r_depth = seen[0] - here[0], seen[1] - z
        iu, iv = half * (seen[2] + here[2]), half * (seen[3] + here[3])
        zu, zv = half * (seen[4] + here[4]), half * (seen[5] + here[5])
        w_intensity = weights[i] / math.sqrt(
            noise[0] + weighting * (iu * iu + iv * iv + r_intensity * r_intensity))
        w_depth = weights[i] / math.sqrt(noise[1] + weighting * (zu * zu + zv * zv + r_depth * r_depth))

        ax, ay = iu * fx * by_z, iv * fy * by_z
        az = -(ax * x + ay * y) * by_z
        _write(by_intensity, count, w_intensity, ax, ay, az, x, y, z, r_intensity)
        ax, ay = zu * fx * by_z, zv * fy * by_z
        az = -(ax * x + ay * y) * by_z - np.float32(1.0)
        _write(by_depth, count, w_depth, ax, ay, az, x, y, z, r_depth)
        largest[0], largest[1] = max(largest[0], w_intensity), max(largest[1], w_depth)
        count += 1
    return count


@njit(inline="always")
def _write(equations, column, weight, ax, ay, az, x, y, z, residual):
    """d residual = a · (ω × q + v) = ω · (q × a) + v · a at the moved point q = (x, y, z)."""
    equations[0, column] = weight * (y * az - z * ay)
    equations[1, column] = weight * (z * ax - x * az)
    equations[2, column] = weight * (x * ay - y * ax)
    equations[3, column] = weight * ax
    equations[4, column] = weight * ay
    equations[5, column] = weight * az
    equations[6, column] = weight * residual


@njit(parallel=True)
def linearise(points, source, target, camera, motion, pixels, weights, noise, weighting, max_jump_m):
    """System of the pixels (P,), numbers v W + u, how many equations each chunk has, and the largest weights.

    A pixel weighs weights / sqrt(noise + weighting (|gradient|² + residual²)), the pre-weights of Jaimez et
    al. 2017, for intensity and depth apart: `weights` (P,), `noise` (2,). Pixels that the target does not see
    have no equations.
    """
    chunks = (len(pixels) + CHUNK - 1) // CHUNK
    system = np.empty((chunks, 2, 7, CHUNK), np.float32)
    counts, largest = np.zeros(chunks, np.int64), np.zeros((chunks, 2), np.float32)
    points, source = points.reshape(-1, 3), source.reshape(-1, 6)
    for chunk in numba.prange(chunks):
        start, end = chunk * CHUNK, min((chunk + 1) * CHUNK, len(pixels))
        counts[chunk] = _fill(
            points, source, target, camera, motion, pixels[start:end], weights[start:end], noise, weighting,
            max_jump_m, system[chunk], largest[chunk])
    best = np.zeros(2, np.float32)
    for chunk in range(chunks):
        best[0], best[1] = max(best[0], largest[chunk, 0]), max(best[1], largest[chunk, 1])
    return system, counts, best


# Sums stay in order: where they may be reordered, fresh code and code from the cache round differently.
@njit(error_model="numpy")
def _absolute_sum(equations, count, scale, twist):
    t = twist.astype(np.float32)
    row0, row1, row2, row3 = equations[0], equations[1], equations[2], equations[3]
    row4, row5, residuals = equations[4], equations[5], equations[6]
    total = np.float32(0.0)
    for i in range(count):
        total += abs(residuals[i] + row0[i] * t[0] + row1[i] * t[1] + row2[i] * t[2] + row3[i] * t[3]
                     + row4[i] * t[4] + row5[i] * t[5])
    return scale * total


@njit(error_model="numpy")
def _normal_equations(equations, count, scale, twist, cauchy_sq, sums):
    """Add JᵀWJ, JᵀWr and rᵀWr of `count` equations to `sums`; W from the residuals at `twist`."""
    t = twist.astype(np.float32)
    zero, one = np.float32(0.0), np.float32(1.0)
    by_cauchy_sq = np.float32(scale * scale / cauchy_sq)
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
    g0 = g1 = g2 = g3 = g4 = g5 = chi = zero
    row0, row1, row2, row3 = equations[0], equations[1], equations[2], equations[3]
    row4, row5, residuals = equations[4], equations[5], equations[6]
    for i in range(count):
        j0, j1, j2, j3, j4, j5, r = row0[i], row1[i], row2[i], row3[i], row4[i], row5[i], residuals[i]
        e = r + j0 * t[0] + j1 * t[1] + j2 * t[2] + j3 * t[3] + j4 * t[4] + j5 * t[5]
        w = one / (one + by_cauchy_sq * e * e)
        chi += w * e * e
        k0, k1, k2, k3, k4, k5 = w * j0, w * j1, w * j2, w * j3, w * j4, w * j5
        h00 += k0 * j0
        h01 += k0 * j1
        h02 += k0 * j2
        h03 += k0 * j3
        h04 += k0 * j4
        h05 += k0 * j5
        h11 += k1 * j1
        h12 += k1 * j2
        h13 += k1 * j3
        h14 += k1 * j4
        h15 += k1 * j5
        h22 += k2 * j2
        h23 += k2 * j3
        h24 += k2 * j4
        h25 += k2 * j5
        h33 += k3 * j3
        h34 += k3 * j4
        h35 += k3 * j5
        h44 += k4 * j4
        h45 += k4 * j5
        h55 += k5 * j5
        g0 += k0 * r
        g1 += k1 * r
        g2 += k2 * r
        g3 += k3 * r
        g4 += k4 * r
        g5 += k5 * r
    found = (h00, h01, h02, h03, h04, h05, h11, h12, h13, h14, h15, h22, h23, h24, h25, h33, h34, h35, h44,
             h45, h55, g0, g1, g2, g3, g4, g5, chi)
    for k in range(_SUMS):
        sums[k] += scale * scale * found[k]


@njit()
def _next_twist(sums, damping, twist):
    """Solve the normal equations in `sums`, write the twist, return the largest change of a part of it."""
    matrix, right = np.empty((6, 6)), np.empty(6)
    k = 0
    trace = 0.0
    for i in range(6):
        for j in range(i, 6):
            matrix[i, j] = matrix[j, i] = sums[k]
            k += 1
        trace += matrix[i, i]
        right[i] = -sums[21 + i]
    for i in range(6):
        matrix[i, i] += damping * trace / 6.0 + 1e-12
    solve_positive6(matrix, right)
    change = 0.0
    for i in range(6):
        change = max(change, abs(right[i] - twist[i]))
        twist[i] = right[i]
    return change


@njit()
def _chunk_sums(equations, count, scales, twist, cauchy, sums):
    """Add what one chunk of equations gives to `sums`, absolute residuals to the first if `cauchy` is 0."""
    for kind in range(2):
        if cauchy == 0.0:
            sums[0] += _absolute_sum(equations[kind], count, scales[kind], twist)
        else:
            _normal_equations(equations[kind], count, scales[kind], twist, cauchy * cauchy, sums)


@njit(parallel=True)
def _sums(system, counts, scales, twist, cauchy):
    partial = np.zeros((len(counts), _SUMS))
    for chunk in numba.prange(len(counts)):
        _chunk_sums(system[chunk], counts[chunk], scales, twist, cauchy, partial[chunk])
    total = np.zeros(_SUMS)
    for chunk in range(len(counts)):
        total += partial[chunk]
    return total


@njit()
def _sums_alone(system, counts, scales, twist, cauchy):
    """As `_sums`, by the calling thread."""
    total, partial = np.zeros(_SUMS), np.empty(_SUMS)
    for chunk in range(len(counts)):
        partial[:] = 0.0
        _chunk_sums(system[chunk], counts[chunk], scales, twist, cauchy, partial)
        total += partial
    return total


@njit()
def solve(system, counts, scales, cauchy_scale, max_rounds, min_gain, min_step, damping, alone):
    """Twist (6,) that minimises Σ F(r + J ξ) over the equations, F the Cauchy loss (eq. 6), by IRLS.

    Its scale c is `cauchy_scale` mean absolute residuals, renewed every round. `scales` (2,) multiply the
    equations of intensity and of depth. With `alone` one thread does it all.
    """
    twist = np.zeros(6)
    equations = 2 * counts.sum()
    if equations == 0:
        return twist
    last = np.inf
    for _ in range(max_rounds):
        absolute = (_sums_alone(system, counts, scales, twist, 0.0) if alone
                    else _sums(system, counts, scales, twist, 0.0))
        cauchy = cauchy_scale * max(absolute[0] / equations, _SMALLEST_MEAN)
        sums = (_sums_alone(system, counts, scales, twist, cauchy) if alone
                else _sums(system, counts, scales, twist, cauchy))
        change = _next_twist(sums, damping, twist)
        if sums[_SUMS - 1] > (1.0 - min_gain) * last or change < min_step:
            break
        last = sums[_SUMS - 1]
    return twist


@njit(parallel=True)
def solve_each(points, source, target, camera, motions, pixels, starts, noise, max_jump_m,
               photometric_weight, cauchy_scale, max_rounds, min_gain, min_step, damping):
    """Twists (K, 6) that improve the motions (K, 3, 4) of K sets of pixels, each by itself, after one warp.

    Set k is pixels[starts[k] : starts[k + 1]]; the rest is as in `linearise` and `solve`.
    """
    twists = np.zeros((len(motions), 6))
    points, source = points.reshape(-1, 3), source.reshape(-1, 6)
    systems = np.empty((len(motions) + len(pixels) // CHUNK + 1, 2, 7, CHUNK), np.float32)
    first = np.zeros(len(motions) + 1, np.int64)
    for k in range(len(motions)):
        first[k + 1] = first[k] + (starts[k + 1] - starts[k] + CHUNK - 1) // CHUNK
    by_size = np.argsort(starts[:-1] - starts[1:])
    half = (len(motions) + 1) // 2
    ones = np.ones(CHUNK, np.float32)
    for job in numba.prange(len(motions)):
        # Every other one to each half of the jobs, so that two threads have as much to do.
        k = by_size[2 * job] if job < half else by_size[2 * (job - half) + 1]
        system, largest = systems[first[k]:first[k + 1]], np.zeros(2, np.float32)
        counts = np.zeros(len(system), np.int64)
        for chunk in range(len(system)):
            start = starts[k] + chunk * CHUNK
            some = pixels[start:min(start + CHUNK, starts[k + 1])]
            counts[chunk] = _fill(
                points, source, target, camera, motions[k], some, ones, noise, np.float32(1.0), max_jump_m,
                system[chunk], largest)
        if counts.sum() > 0:
            scales = np.array([photometric_weight / largest[0], 1.0 / largest[1]])
            twists[k] = solve(
                system, counts, scales, cauchy_scale, max_rounds, min_gain, min_step, damping, True)
    return twists
