"""A marker's pose fitted to its printed edges: Gauss-Newton for one or two poses in one call, on the host's CPU.

The derivation stands in ``warp_ar.tracking.tracking``. In NumPy a fit is a hundred calls on arrays of a few hundred
numbers, which hold Python's lock; here it is one, which does not. Of the picture it reads what edges need: nine places
across each, decoded as they are read. All is float64 but the samples, which are interpolated in float32.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_POSES: Final = 2
"""Poses that are fitted in one call: a plane has two that look alike."""
TAPS: Final = 9
"""Samples across an edge."""
UNKNOWNS: Final = 9
"""Rotation vector, translation, and the three numbers of the shift of edges."""
MIN_REACH: Final = 1.0
"""Pixels: an edge with less environment than this to its neighbours is not measured; the blur of one would reach the
other."""
DONE: Final = 0.05
"""Pixels: a Gauss-Newton step that moves no edge further is the last; it converges fast enough that the next would move
a tenth of it."""
MIN_EDGES: Final = 16
"""Fewest measured edge points for a refinement: nine unknowns, and something left to vote."""
NOISE_FLOOR: Final = 0.03
"""Pixels: smallest standard deviation that an edge point is ever given credit for (sampling, lens model, print)."""
CORRELATED: Final = 2.0
"""Neighbouring edge points share pixels, so that many of them count as one."""
MIN_CELLS: Final = 8
"""Fewest cells in the picture that tell a pattern."""

_TAPS = wp.constant(TAPS)
_UNKNOWNS = wp.constant(UNKNOWNS)
_MIN_REACH = wp.constant(wp.float64(MIN_REACH))
_DONE = wp.constant(wp.float64(DONE))
_MIN_EDGES = wp.constant(MIN_EDGES)
_NOISE_FLOOR = wp.constant(wp.float64(NOISE_FLOOR))
_CORRELATED = wp.constant(wp.float64(CORRELATED))
_MIN_CELLS = wp.constant(MIN_CELLS)
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_TINY = wp.constant(wp.float64(1e-9))
_NEAR = wp.constant(wp.float64(1e-6))
_CLEARANCE = wp.constant(wp.float64(0.45))
_CONTRAST = wp.constant(wp.float64(0.3))
_LEAST_CONTRAST = wp.constant(wp.float64(1e-4))
_DEVIATION = wp.constant(wp.float64(1.4826))
_TUKEY = wp.constant(wp.float64(4.7))
_PERCENTILE = wp.constant(wp.float64(0.05))
_EPSILON = wp.constant(wp.float64(2.220446049250313e-16))

vec8d = wp.types.vector(8, wp.float64)
vec9d = wp.types.vector(UNKNOWNS, wp.float64)
mat99d = wp.types.matrix((UNKNOWNS, UNKNOWNS), wp.float64)


@wp.struct
class Print:
    """Printed pattern in the world's frame, metres: m points on edges, c cells."""

    points: wp.array[wp.vec3d]
    tangents: wp.array[wp.vec3d]
    normals: wp.array[wp.vec3d]  # toward white
    clearances: wp.array[wp.float64]  # to the nearest parallel edge
    outline: wp.array[wp.vec3d]  # four corners
    cells: wp.array[wp.vec3d]
    white: wp.array[wp.float64]  # 1 where a cell is white


@wp.struct
class Lens:
    """A camera with distortion, in float64."""

    focal: wp.vec2d
    principal: wp.vec2d
    distortion: vec8d  # OpenCV's k1 k2 p1 p2 k3 k4 k5 k6


@wp.struct
class Asked:
    """Input of one call; the host writes it."""

    poses: wp.int32
    reaches: wp.int32
    row_start: wp.int32  # the part of the picture that is read
    row_stop: wp.int32
    column_start: wp.int32
    column_stop: wp.int32


@wp.struct
class EdgeFit:
    """One pose, before and after."""

    rotation: wp.mat33d  # camera_from_world
    translation: wp.vec3d
    fitted: wp.int32  # 1: the pose is one that fits edges
    error: wp.float64  # root mean square residual, pixels
    support: wp.float64  # share of the printed edges that agree
    cost: wp.float64  # robust mean squared residual, pixels squared
    pattern: wp.float64  # correlation of the cells' brightness with the print


@wp.struct
class Scratch:
    """Room for each pose's equations: rows, and the normal ones with their right sides."""

    design: wp.array2d[vec9d]  # (poses, m)
    work: wp.array3d[wp.float64]  # (poses, 4, max(m, c)): contrasts or residuals, offsets, weights, what is sorted
    normal: wp.array3d[wp.float64]  # (poses, 9, 10)


@wp.struct
class Projected:
    """A point in the picture, and its derivatives by the camera's point."""

    at: wp.vec2d
    dx: wp.vec3d
    dy: wp.vec3d


@wp.func
def project_point(lens: Lens, p: wp.vec3d) -> Projected:
    """Pixel of a camera's point; x d/dx of the rational model by the chain rule over r^2 = x^2 + y^2."""
    k = lens.distortion
    x = p[0] / p[2]
    y = p[1] / p[2]
    r2 = x * x + y * y
    above = _ONE + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    below = _ONE + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = above / below
    slope_above = k[0] + r2 * (_TWO * k[1] + r2 * wp.float64(3.0) * k[4])
    slope_below = k[5] + r2 * (_TWO * k[6] + r2 * wp.float64(3.0) * k[7])
    slope = _TWO * (slope_above - radial * slope_below) / below
    xx = radial + slope * x * x + _TWO * k[2] * y + wp.float64(6.0) * k[3] * x
    xy = slope * x * y + _TWO * (k[2] * x + k[3] * y)
    yy = radial + slope * y * y + _TWO * k[3] * x + wp.float64(6.0) * k[2] * y
    by_x = wp.vec3d(_ONE / p[2], _ZERO, -x / p[2])
    by_y = wp.vec3d(_ZERO, _ONE / p[2], -y / p[2])
    found = Projected()
    found.at = wp.vec2d(
        lens.focal[0] * (x * radial + _TWO * k[2] * x * y + k[3] * (r2 + _TWO * x * x)) + lens.principal[0],
        lens.focal[1] * (y * radial + k[2] * (r2 + _TWO * y * y) + _TWO * k[3] * x * y) + lens.principal[1],
    )
    found.dx = lens.focal[0] * (xx * by_x + xy * by_y)
    found.dy = lens.focal[1] * (xy * by_x + yy * by_y)
    return found


@wp.func
def sample_linear(gray: wp.array2d[wp.uint8], linear: wp.array[wp.float32], x: wp.float64, y: wp.float64) -> wp.float64:
    """Linear light between four pixels; the place is inside the picture."""
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    right = wp.min(column + 1, gray.shape[1] - 1)
    below = wp.min(row + 1, gray.shape[0] - 1)
    a = wp.float32(x - wp.float64(column))
    b = wp.float32(y - wp.float64(row))
    first = linear[int(gray[row, column])]
    second = linear[int(gray[row, right])]
    third = linear[int(gray[below, column])]
    fourth = linear[int(gray[below, right])]
    upper = first + a * (second - first)
    lower = third + a * (fourth - third)
    return wp.float64(upper + b * (lower - upper))


@wp.func
def select_value(values: wp.array[wp.float64], count: wp.int32, place: wp.int32) -> wp.float64:
    """The value that would stand at ``place`` if they were sorted; smaller ones then stand before it [Hoare 1961]."""
    low = int(0)
    high = count - 1
    while low < high:
        pivot = values[(low + high) / 2]
        i = int(low)
        j = int(high)
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                held = values[i]
                values[i] = values[j]
                values[j] = held
                i += 1
                j -= 1
        if place <= j:
            high = j
        elif place >= i:
            low = i
        else:
            low = place
            high = place
    return values[place]


@wp.func
def median_value(values: wp.array[wp.float64], count: wp.int32) -> wp.float64:
    """The middle one, or the mean of both."""
    middle = count / 2
    found = select_value(values, count, middle)
    if count % 2 == 1:
        return found
    below = values[0]
    for i in range(1, middle):
        below = wp.max(below, values[i])
    return _HALF * (below + found)


@wp.func
def percentile_value(values: wp.array[wp.float64], count: wp.int32, share: wp.float64) -> wp.float64:
    """A percentile between two values, linearly."""
    at = share * wp.float64(count - 1)
    low = int(wp.floor(at))
    first = select_value(values, count, low)
    second = select_value(values, count, wp.min(low + 1, count - 1))
    return first + (second - first) * (at - wp.float64(low))


@wp.func
def solve_system(system: wp.array2d[wp.float64], size: wp.int32) -> wp.int32:
    """Solve ``size`` equations in place, their right sides in the last column; 0 where they are singular."""
    for i in range(size):
        best = int(i)
        for row in range(i + 1, size):
            if wp.abs(system[row, i]) > wp.abs(system[best, i]):
                best = row
        if system[best, i] == _ZERO:
            return 0
        if best != i:
            for column in range(i, size + 1):
                held = system[i, column]
                system[i, column] = system[best, column]
                system[best, column] = held
        for row in range(i + 1, size):
            factor = system[row, i] / system[i, i]
            for column in range(i + 1, size + 1):
                system[row, column] = system[row, column] - factor * system[i, column]
    for back in range(size):
        i = size - 1 - back
        rest = system[i, size]
        for column in range(i + 1, size):
            rest -= system[i, column] * system[column, size]
        system[i, size] = rest / system[i, i]
    return 1


@wp.func
def add_equations(
    design: wp.array[vec9d],
    offsets: wp.array[wp.float64],
    weights: wp.array[wp.float64],
    count: wp.int32,
    normal: wp.array2d[wp.float64],
):
    """Normal equations of weighted rows.

    The shift of edges is a fraction of a pixel: that is its prior, without which a print without inner edges could not
    tell it from distance.
    """
    products = mat99d()
    right = vec9d()
    for k in range(count):
        row = design[k]
        weighted = weights[k] * row
        products += wp.outer(weighted, row)
        right += offsets[k] * weighted
    for i in range(_UNKNOWNS):
        for j in range(_UNKNOWNS):
            normal[i, j] = products[i, j]
        if i >= 6:
            normal[i, i] = products[i, i] + _ONE
        normal[i, _UNKNOWNS] = right[i]


@wp.func
def turned(step: wp.vec3d, rotation: wp.mat33d) -> wp.mat33d:
    """A rotation turned on by a rotation vector (Rodrigues)."""
    angle = wp.length(step)
    if angle < _EPSILON:
        return rotation
    axis = step / angle
    c = wp.cos(angle)
    cross = wp.mat33d(_ZERO, -axis[2], axis[1], axis[2], _ZERO, -axis[0], -axis[1], axis[0], _ZERO)
    more = c * wp.identity(n=3, dtype=wp.float64) + (_ONE - c) * wp.outer(axis, axis) + wp.sin(angle) * cross
    return more * rotation


@wp.func
def measure_edges(
    gray: wp.array2d[wp.uint8],
    linear: wp.array[wp.float32],
    printed: Print,
    lens: Lens,
    asked: Asked,
    fit: EdgeFit,
    reach: wp.float64,
    design: wp.array[vec9d],
    work: wp.array2d[wp.float64],
) -> wp.int32:
    """One row of equations for each edge that is seen, and how far it lies from where it is expected.

    Returns:
        How many there are; fewer than ``MIN_EDGES``: too few.
    """
    contrasts = work[0]
    offsets = work[1]
    sorted_out = work[3]
    m = printed.points.shape[0]
    left = wp.float64(asked.column_start)
    right = wp.float64(asked.column_stop - 1)
    top = wp.float64(asked.row_start)
    bottom = wp.float64(asked.row_stop - 1)
    inside = int(0)
    for i in range(m):
        contrasts[i] = -wp.float64(1e30)
        arm = fit.rotation * printed.points[i]
        point = arm + fit.translation
        if point[2] <= _NEAR:
            return 0
        found = project_point(lens, point)
        tangent = fit.rotation * printed.tangents[i]
        ax = wp.dot(found.dx, tangent)
        ay = wp.dot(found.dy, tangent)
        length = wp.max(wp.sqrt(ax * ax + ay * ay), _TINY)
        nx = -ay / length
        ny = ax / length
        across = fit.rotation * printed.normals[i]
        width = nx * wp.dot(found.dx, across) + ny * wp.dot(found.dy, across)
        if width < _ZERO:
            nx = -nx
            ny = -ny
            width = -width
        half = wp.min(_CLEARANCE * width * printed.clearances[i], reach)
        x = found.at[0]
        y = found.at[1]
        fits = wp.min(x - half * nx, x + half * nx) >= left and wp.max(x - half * nx, x + half * nx) <= right
        fits = fits and wp.min(y - half * ny, y + half * ny) >= top and wp.max(y - half * ny, y + half * ny) <= bottom
        if fits and half >= _MIN_REACH:
            # Trapezoid rule over [-1, 1]; each end's level is the mean of its two outermost samples.
            black = _ZERO
            white = _ZERO
            area = _ZERO
            for tap in range(_TAPS):
                along = half * (wp.float64(tap) * wp.float64(0.25) - _ONE)
                value = sample_linear(gray, linear, x + along * nx, y + along * ny)
                weight = wp.float64(0.25)
                if tap == 0 or tap == _TAPS - 1:
                    weight = wp.float64(0.125)
                area += weight * value
                if tap < 2:
                    black += _HALF * value
                if tap >= _TAPS - 2:
                    white += _HALF * value
            contrast = white - black
            contrasts[i] = contrast
            sorted_out[inside] = contrast
            inside += 1
            if contrast > _LEAST_CONTRAST:
                offsets[i] = wp.min(wp.max(half * ((_TWO * white - area) / contrast - _ONE), -half), half)
            pull = nx * found.dx + ny * found.dy
            turning = wp.cross(arm, pull)
            design[i] = vec9d(
                turning[0],
                turning[1],
                turning[2],
                pull[0],
                pull[1],
                pull[2],
                _ONE,
                nx * nx - ny * ny,
                _TWO * nx * ny,
            )
    if inside < _MIN_EDGES:
        return 0
    least = wp.max(_CONTRAST * median_value(sorted_out, inside), _LEAST_CONTRAST)
    seen = int(0)
    for i in range(m):
        if contrasts[i] > least:
            offsets[seen] = offsets[i]
            design[seen] = design[i]
            seen += 1
    return seen


@wp.func
def solve_robustly(
    design: wp.array[vec9d], work: wp.array2d[wp.float64], count: wp.int32, normal: wp.array2d[wp.float64]
) -> wp.float64:
    """Reweighted least squares; the solution is left in the last column of ``normal``.

    Returns:
        Spread of the residuals, pixels; negative where there is no solution.
    """
    residuals = work[0]
    offsets = work[1]
    weights = work[2]
    sorted_out = work[3]
    spread = _ZERO
    for k in range(count):
        weights[k] = _ONE
    for _turn in range(3):
        add_equations(design, offsets, weights, count, normal)
        if solve_system(normal, _UNKNOWNS) == 0:
            return -_ONE
        solution = vec9d()
        for j in range(_UNKNOWNS):
            solution[j] = normal[j, _UNKNOWNS]
        for k in range(count):
            residual = offsets[k] - wp.dot(design[k], solution)
            residuals[k] = residual
            sorted_out[k] = wp.abs(residual)
        spread = wp.max(_DEVIATION * select_value(sorted_out, count, count / 2), _NOISE_FLOOR)
        for k in range(count):
            # Tukey's weight: an edge that is covered, or lies under a reflection, must not pull at all.
            share = residuals[k] / (_TUKEY * spread)
            weight = wp.max(_ONE - share * share, _ZERO)
            weights[k] = weight * weight
    for j in range(_UNKNOWNS):
        if not wp.isfinite(normal[j, _UNKNOWNS]):
            return -_ONE
    return spread


@wp.func
def correlate_cells(
    gray: wp.array2d[wp.uint8],
    linear: wp.array[wp.float32],
    printed: Print,
    lens: Lens,
    asked: Asked,
    fit: EdgeFit,
    work: wp.array2d[wp.float64],
) -> wp.float64:
    """Correlation, -1 to 1, of the brightness at cell centres with the print; 0 where it cannot be seen."""
    values = work[0]
    white = work[1]
    sorted_out = work[3]
    count = int(0)
    for i in range(printed.cells.shape[0]):
        point = fit.rotation * printed.cells[i] + fit.translation
        if point[2] <= _NEAR:
            return _ZERO
        at = project_point(lens, point).at
        x = wp.float64(wp.float32(at[0]))
        y = wp.float64(wp.float32(at[1]))
        inside = x >= wp.float64(asked.column_start) and x <= wp.float64(asked.column_stop - 1)
        if inside and y >= wp.float64(asked.row_start) and y <= wp.float64(asked.row_stop - 1):
            values[count] = sample_linear(gray, linear, x, y)
            sorted_out[count] = values[count]
            white[count] = printed.white[i]
            count += 1
    if count < _MIN_CELLS:
        return _ZERO
    # Lamps' reflections and sparkle must not outvote the print.
    low = percentile_value(sorted_out, count, _PERCENTILE)
    high = percentile_value(sorted_out, count, _ONE - _PERCENTILE)
    mean = _ZERO
    mean_white = _ZERO
    for i in range(count):
        values[i] = wp.min(wp.max(values[i], low), high)
        mean += values[i] / wp.float64(count)
        mean_white += white[i] / wp.float64(count)
    aa = _ZERO
    ab = _ZERO
    bb = _ZERO
    for i in range(count):
        a = values[i] - mean
        b = white[i] - mean_white
        aa += a * a
        ab += a * b
        bb += b * b
    scale = wp.sqrt(aa * bb)
    if scale > _TINY:
        return ab / scale
    return _ZERO


@wp.kernel
def fit_edges_kernel(
    # In:
    gray: wp.array2d[wp.uint8],
    linear: wp.array[wp.float32],
    printed: Print,
    lens: Lens,
    asked: wp.array[Asked],
    reaches: wp.array[wp.float64],
    # Out:
    scratch: Scratch,
    fits_out: wp.array[EdgeFit],
    information_out: wp.array3d[wp.float64],
):
    """One thread per pose."""
    pose = wp.tid()
    call = asked[0]
    if pose >= call.poses:
        return
    fit = fits_out[pose]
    fit.fitted = 0
    design = scratch.design[pose]
    work = scratch.work[pose]
    normal = scratch.normal[pose]
    count = int(0)
    spread = -_ONE
    step = int(0)
    while step < call.reaches:
        reach = reaches[step]
        count = measure_edges(gray, linear, printed, lens, call, fit, reach, design, work)
        spread = -_ONE
        if count >= _MIN_EDGES:
            spread = solve_robustly(design, work, count, normal)
        step += 1
        if spread < _ZERO:
            step = call.reaches
        else:
            turn = wp.vec3d(normal[0, _UNKNOWNS], normal[1, _UNKNOWNS], normal[2, _UNKNOWNS])
            fit.rotation = turned(turn, fit.rotation)
            shift = wp.vec3d(normal[3, _UNKNOWNS], normal[4, _UNKNOWNS], normal[5, _UNKNOWNS])
            fit.translation = fit.translation + shift
            motion = vec9d()
            for j in range(6):
                motion[j] = normal[j, _UNKNOWNS]
            moved = _ZERO
            for k in range(count):
                moved = wp.max(moved, wp.abs(wp.dot(design[k], motion)))
            if reach == reaches[call.reaches - 1] or (reach <= reaches[1] and moved < _DONE):
                step = call.reaches
    if spread >= _ZERO:
        fit.fitted = 1
        for i in range(4):
            if (fit.rotation * printed.outline[i] + fit.translation)[2] <= _ZERO:
                fit.fitted = 0
        axis = wp.vec3d(fit.rotation[0, 2], fit.rotation[1, 2], fit.rotation[2, 2])
        if wp.dot(axis, fit.translation) >= _ZERO:
            fit.fitted = 0
    if fit.fitted == 1:
        residuals = work[0]
        weights = work[2]
        kept = _ZERO
        squares = _ZERO
        cost = _ZERO
        for k in range(count):
            square = residuals[k] * residuals[k]
            kept += weights[k]
            squares += weights[k] * square
            cost += wp.min(square, _ONE)
        fit.error = wp.sqrt(squares / kept)
        fit.support = kept / wp.float64(printed.points.shape[0])
        fit.cost = cost / wp.float64(count)
        add_equations(design, work[1], weights, count, normal)
        # The pose's, with the shift of edges eliminated.
        for back in range(3):
            pivot = _UNKNOWNS - 1 - back
            for i in range(pivot):
                factor = normal[i, pivot] / normal[pivot, pivot]
                for j in range(pivot):
                    normal[i, j] = normal[i, j] - factor * normal[pivot, j]
        for i in range(6):
            for j in range(6):
                information_out[pose, i, j] = normal[i, j] / (_CORRELATED * spread * spread)
    if fit.fitted == 1 or call.reaches == 0:
        fit.pattern = correlate_cells(gray, linear, printed, lens, call, fit, work)
    fits_out[pose] = fit


def record_fit_edges(
    gray: wp.array,
    linear: wp.array,
    printed: Print,
    lens: Lens,
    asked: wp.array,
    reaches: wp.array,
    fits_out: wp.array,
    information_out: wp.array,
) -> Callable[[], None]:
    """Allocate what fits need, and load the kernel: what is given fits ``MOST_POSES`` poses or fewer, again and again.

    Args:
        gray: The picture, uint8 (rows, columns), on the CPU as all of these.
        linear: Linear light of each code, float32 (256,).
        printed: What to fit.
        lens: The camera.
        asked: One record of ``Asked``.
        reaches: Half width of the sampled window in pixels, float64, per Gauss-Newton step; with none only the print
            is correlated.
        fits_out: ``MOST_POSES`` records of ``EdgeFit``: the pose to begin with, then the one that fits. Where
            ``fitted`` is 0 the pose is of no use.
        information_out: (``MOST_POSES``, 6, 6) inverse covariance of rotation vector and translation.
    """
    m = printed.points.shape[0]
    scratch = Scratch()
    shapes = {
        "work": (MOST_POSES, 4, max(m, printed.cells.shape[0])),
        "normal": (MOST_POSES, UNKNOWNS, UNKNOWNS + 1),
    }
    scratch.design = wp.zeros((MOST_POSES, m), dtype=vec9d, device="cpu")
    for name, shape in shapes.items():
        setattr(scratch, name, wp.zeros(shape, dtype=wp.float64, device="cpu"))
    inputs = [gray, linear, printed, lens, asked, reaches]
    outputs = [scratch, fits_out, information_out]
    command = wp.launch(fit_edges_kernel, MOST_POSES, inputs, outputs, device="cpu", record_cmd=True)
    return command.launch  # type: ignore[no-any-return]
