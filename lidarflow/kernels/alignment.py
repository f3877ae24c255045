"""Direct alignment of RGB-D images: linearised residuals of a warp, and robust least squares over them.

An equation is a column of a (7, M) float32 array: six derivatives by a twist of the motion (rotation
first, applied after it), then the residual. Columns 0 .. P−1 are of intensity, P .. 2P−1 of depth, zero
where a pixel has none. Packed images are those of images.py. Sums run over chunks of a fixed size, added in
order: the number of threads changes nothing.
"""

import math

import numba
import numpy as np

from lidarflow.kernels.linalg import solve_positive6

_CHUNK = 2048
_SUMS = 28               # 21 of the upper triangle of JᵀWJ, 6 of JᵀWr, 1 of rᵀWr
NEAREST_M = 0.01        # points this near to the camera, or behind it, are not seen
_SMALLEST_MEAN = 1e-5    # keeps the robust scale positive where everything fits perfectly
# Sums in any order, and no exception for a division by zero: without both, no loop uses vector registers.
_VECTORISED = {"fastmath": {"reassoc", "nsz", "arcp", "contract"}, "error_model": "numpy"}


@numba.njit(cache=True, inline="always", error_model="numpy")
def look_up(target, u, v, max_jump_m, layers, seen):
    """Fill `seen` with the first `layers` of a packed image at (u, v); False if it has no depth there.

    That is outside the image, or where one of the four pixels around has none. Bilinear, but the nearest
    pixel alone where the four depths differ by more than `max_jump_m`.
    """
    rows, columns = target.shape[0], target.shape[1]
    if not (u >= 0.0 and v >= 0.0 and u <= columns - 1 and v <= rows - 1):
        return False
    left, top = min(int(u), columns - 2), min(int(v), rows - 2)
    share_u, share_v = u - np.float32(left), v - np.float32(top)
    z00, z01 = target[top, left, 1], target[top, left + 1, 1]
    z10, z11 = target[top + 1, left, 1], target[top + 1, left + 1, 1]
    nearest, farthest = min(min(z00, z01), min(z10, z11)), max(max(z00, z01), max(z10, z11))
    if nearest <= 0.0:
        return False
    if farthest - nearest > max_jump_m:
        i = left + (1 if share_u >= 0.5 else 0)
        j = top + (1 if share_v >= 0.5 else 0)
        for k in range(layers):
            seen[k] = target[j, i, k]
        return True
    one = np.float32(1.0)
    w00, w01 = (one - share_u) * (one - share_v), share_u * (one - share_v)
    w10, w11 = (one - share_u) * share_v, share_u * share_v
    for k in range(layers):
        seen[k] = (w00 * target[top, left, k] + w01 * target[top, left + 1, k]
                   + w10 * target[top + 1, left, k] + w11 * target[top + 1, left + 1, k])
    return True


@numba.njit(cache=True, inline="always", error_model="numpy")
def moved(depth, v, u, camera, motion):
    """Where a motion (3, 4) takes the point of a pixel: x, y, z in metres."""
    x, y = (u - camera[2]) / camera[0] * depth, (v - camera[3]) / camera[1] * depth
    return (motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * depth + motion[0, 3],
            motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * depth + motion[1, 3],
            motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * depth + motion[2, 3])


@numba.njit(cache=True, inline="always", error_model="numpy")
def _equations_of(source, target, v, u, camera, motion, prior, noise, weighting, max_jump_m, seen, system,
                  at_intensity, at_depth):
    """Write both equations of a pixel, weighted; return whether there are any, and the two weights.

    The gradients are the means of those of either image: that linearisation is good to second order.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    depth = source[v, u, 1]
    if depth <= 0.0 or prior <= 0.0:
        return False, np.float32(0.0), np.float32(0.0)
    x, y, z = moved(depth, v, u, camera, motion)
    if z <= NEAREST_M:
        return False, np.float32(0.0), np.float32(0.0)
    by_z = np.float32(1.0) / z
    if not look_up(target, fx * x * by_z + cx, fy * y * by_z + cy, max_jump_m, 6, seen):
        return False, np.float32(0.0), np.float32(0.0)
    half = np.float32(0.5)
    r_intensity, r_depth = seen[0] - source[v, u, 0], seen[1] - z
    iu, iv = half * (seen[2] + source[v, u, 2]), half * (seen[3] + source[v, u, 3])
    zu, zv = half * (seen[4] + source[v, u, 4]), half * (seen[5] + source[v, u, 5])
    w_intensity = prior / math.sqrt(
        noise[0] + weighting * (iu * iu + iv * iv + r_intensity * r_intensity))
    w_depth = prior / math.sqrt(noise[1] + weighting * (zu * zu + zv * zv + r_depth * r_depth))

    ax, ay = iu * fx * by_z, iv * fy * by_z
    _row(system, at_intensity, w_intensity, ax, ay, -(ax * x + ay * y) * by_z, x, y, z, r_intensity)
    ax, ay = zu * fx * by_z, zv * fy * by_z
    _row(system, at_depth, w_depth, ax, ay, -(ax * x + ay * y) * by_z - np.float32(1.0), x, y, z, r_depth)
    return True, w_intensity, w_depth


@numba.njit(cache=True, inline="always", error_model="numpy")
def _row(system, column, weight, ax, ay, az, x, y, z, residual):
    """d residual = a · (ω × q + v) = ω · (q × a) + v · a at the moved point q = (x, y, z)."""
    system[0, column] = weight * (y * az - z * ay)
    system[1, column] = weight * (z * ax - x * az)
    system[2, column] = weight * (x * ay - y * ax)
    system[3, column] = weight * ax
    system[4, column] = weight * ay
    system[5, column] = weight * az
    system[6, column] = weight * residual


@numba.njit(cache=True, parallel=True, error_model="numpy")
def linearise(source, target, camera, motion, prior, noise, weighting, max_jump_m):
    """Equations (7, 2 H W) of all pixels of a packed source image, their number of pixels, largest weights.

    Pixel weights are prior / sqrt(noise + weighting (|gradient|² + residual²)) (Jaimez et al. 2017, eqs. 18
    and 19), for intensity and depth apart; `prior` (H, W) with 0 for pixels to leave out, `noise` (2,).
    `camera` (4,) is fx, fy, cx, cy, `motion` (3, 4) target_from_source, all float32.
    """
    rows, columns = prior.shape
    system = np.empty((7, 2 * rows * columns), np.float32)
    counts, largest = np.zeros(rows, np.int64), np.zeros((rows, 2), np.float32)
    for v in numba.prange(rows):
        seen = np.empty(6, np.float32)
        for u in range(columns):
            at_intensity = v * columns + u
            at_depth = rows * columns + at_intensity
            used, w_intensity, w_depth = _equations_of(
                source, target, v, u, camera, motion, prior[v, u], noise, weighting, max_jump_m, seen, system,
                at_intensity, at_depth)
            if used:
                counts[v] += 1
                largest[v, 0] = max(largest[v, 0], w_intensity)
                largest[v, 1] = max(largest[v, 1], w_depth)
            else:
                for k in range(7):
                    system[k, at_intensity] = system[k, at_depth] = 0.0
    best = np.zeros(2, np.float32)
    for v in range(rows):
        best[0], best[1] = max(best[0], largest[v, 0]), max(best[1], largest[v, 1])
    return system, counts.sum(), best


@numba.njit(cache=True, **_VECTORISED)
def _absolute_sum(system, start, end, scale, twist):
    t = twist.astype(np.float32)
    part = system[:, start:end]
    total = np.float32(0.0)
    for i in range(end - start):
        total += abs(part[6, i] + part[0, i] * t[0] + part[1, i] * t[1] + part[2, i] * t[2]
                     + part[3, i] * t[3] + part[4, i] * t[4] + part[5, i] * t[5])
    return scale * total


@numba.njit(cache=True, **_VECTORISED)
def _normal_equations(system, start, end, scale, twist, cauchy_sq, sums):
    """Add JᵀWJ, JᵀWr and rᵀWr of columns start .. end−1 to `sums`; W from the residuals at `twist`."""
    t = twist.astype(np.float32)
    zero, one = np.float32(0.0), np.float32(1.0)
    by_cauchy_sq = np.float32(scale * scale / cauchy_sq)
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
    g0 = g1 = g2 = g3 = g4 = g5 = chi = zero
    row0, row1, row2 = system[0, start:end], system[1, start:end], system[2, start:end]
    row3, row4, row5 = system[3, start:end], system[4, start:end], system[5, start:end]
    residuals = system[6, start:end]
    for i in range(end - start):
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def _chunk_sums(system, chunk, chunks, scales, twist, cauchy, sums):
    """Add what one chunk of columns gives to `sums`, absolute residuals to the first if `cauchy` is 0."""
    half = system.shape[1] // 2
    kind, number = chunk // chunks, chunk % chunks
    start, end = kind * half + number * _CHUNK, kind * half + min((number + 1) * _CHUNK, half)
    if cauchy == 0.0:
        sums[0] += _absolute_sum(system, start, end, scales[kind], twist)
    else:
        _normal_equations(system, start, end, scales[kind], twist, cauchy * cauchy, sums)


@numba.njit(cache=True, parallel=True)
def _sums(system, scales, twist, cauchy):
    chunks = (system.shape[1] // 2 + _CHUNK - 1) // _CHUNK
    partial = np.zeros((2 * chunks, _SUMS))
    for chunk in numba.prange(2 * chunks):
        _chunk_sums(system, chunk, chunks, scales, twist, cauchy, partial[chunk])
    total = np.zeros(_SUMS)
    for chunk in range(2 * chunks):
        total += partial[chunk]
    return total


@numba.njit(cache=True)
def _sums_alone(system, scales, twist, cauchy):
    """As `_sums`, by the calling thread."""
    chunks = (system.shape[1] // 2 + _CHUNK - 1) // _CHUNK
    total = np.zeros(_SUMS)
    for chunk in range(2 * chunks):
        _chunk_sums(system, chunk, chunks, scales, twist, cauchy, total)
    return total


@numba.njit(cache=True)
def solve(system, count, scales, cauchy_scale, max_rounds, min_gain, min_step, damping, alone):
    """Twist (6,) that minimises Σ F(r + J ξ) over the equations, F the Cauchy loss (eq. 6), by IRLS.

    Its scale c is `cauchy_scale` mean absolute residuals, renewed every round. `count` pixels have
    equations; `scales` (2,) multiply those of intensity and of depth. With `alone` one thread does it all.
    """
    twist = np.zeros(6)
    if count == 0:
        return twist
    last = np.inf
    for _ in range(max_rounds):
        absolute = _sums_alone(system, scales, twist, 0.0) if alone else _sums(system, scales, twist, 0.0)
        cauchy = cauchy_scale * max(absolute[0] / (2 * count), _SMALLEST_MEAN)
        sums = (_sums_alone(system, scales, twist, cauchy) if alone
                else _sums(system, scales, twist, cauchy))
        change = _next_twist(sums, damping, twist)
        if sums[_SUMS - 1] > (1.0 - min_gain) * last or change < min_step:
            break
        last = sums[_SUMS - 1]
    return twist


@numba.njit(cache=True, parallel=True, error_model="numpy")
def solve_each(source, target, camera, motions, pixels, starts, noise, max_jump_m, photometric_weight,
               cauchy_scale, max_rounds, min_gain, min_step, damping):
    """Twists (K, 6) that improve the motions (K, 3, 4) of K sets of pixels, each by itself, after one warp.

    Set k is the pixels v W + u in pixels[starts[k] : starts[k + 1]]; the rest is as in `linearise` and
    `solve`.
    """
    columns = source.shape[1]
    twists = np.zeros((len(motions), 6))
    systems = np.empty(14 * len(pixels), np.float32)
    by_size = np.argsort(starts[:-1] - starts[1:])
    order = np.concatenate((by_size[::2], by_size[1::2]))   # so that two threads have as much to do
    for job in numba.prange(len(motions)):
        k = order[job]
        size = starts[k + 1] - starts[k]
        system = systems[14 * starts[k]:14 * starts[k + 1]].reshape(7, 2 * size)
        system[:] = 0.0
        seen = np.empty(6, np.float32)
        count, best_intensity, best_depth = 0, np.float32(0.0), np.float32(0.0)
        for i in range(size):
            pixel = pixels[starts[k] + i]
            used, w_intensity, w_depth = _equations_of(
                source, target, pixel // columns, pixel % columns, camera, motions[k], np.float32(1.0), noise,
                np.float32(1.0), max_jump_m, seen, system, i, size + i)
            if used:
                count += 1
                best_intensity, best_depth = max(best_intensity, w_intensity), max(best_depth, w_depth)
        if count > 0:
            scales = np.array([photometric_weight / best_intensity, 1.0 / best_depth])
            twists[k] = solve(
                system, count, scales, cauchy_scale, max_rounds, min_gain, min_step, damping, True)
    return twists
