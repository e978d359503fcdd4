"""Float64 twins of ``warp_ar.kernels.receiver.receiver_cells``: brute force over samples and patches."""

import numpy as np

from tests.twins import environment_shadow

GREY = 0.5


def meet_box(origin, directions, low, high):
    """Distance along rays (n, 3) to a box around which the origin is not, and the normal there; inf if none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = ((np.asarray(edge) - origin) / directions for edge in (low, high))
    first, last = np.minimum(near, far), np.maximum(near, far)
    t, axis = first.max(-1), first.argmax(-1)
    t = np.where((t > 0) & (t <= last.min(-1)), t, np.inf)
    return t, -np.eye(3)[axis] * np.sign(np.take_along_axis(directions, axis[:, None], -1))


def meet_ball(origin, directions, center, radius):
    """Distance along rays (n, 3) to a ball around which the origin is not, and the normal there; inf if none."""
    to_center = np.asarray(center) - origin
    along = directions @ to_center
    inside = np.sqrt(np.maximum(radius**2 - to_center @ to_center + along**2, 0))
    t = np.where(environment_shadow.meets_sphere(origin, directions, center, radius), along - inside, np.inf)
    return t, (np.where(np.isfinite(t), t, 0)[:, None] * directions - to_center) / radius


def share_environment(point, normal, directions, measure, radiance, distances, boxes, balls, facing):
    """Share of the environment at a point, (3,).

    Args:
        point: Where.
        normal: Of the surface there.
        directions: (n, 3), of the samples.
        measure: (n,), solid angles.
        radiance: (n, 3).
        distances: (n,), inf for the environment.
        boxes: (low, high) corners each.
        balls: (center, radius, reflectance) each.
        facing: From a normal (n, 3) to the mean radiance before it, (n, 3).
    """
    weight = (np.maximum(directions @ normal, 0) * measure)[:, None]
    nearest, seen = np.array(distances, float), np.array(radiance, float)
    items = [(*meet_ball(point, directions, c, r), reflectance) for c, r, reflectance in balls]
    items += [(*meet_box(point, directions, *box), GREY) for box in boxes]
    for t, normals, reflectance in items:
        hidden = t < nearest
        seen = np.where(hidden[:, None], reflectance * facing(normals), seen)
        nearest = np.where(hidden, t, nearest)
    return np.minimum((weight * seen).sum(0) / (weight * radiance).sum(0), 1)


def gather_light(points, normals, positions, facings, flux, areas):
    """Irradiance of points (n, 3) by patches, (n, 3)."""
    way = positions[None] - points[:, None]
    squared = (way**2).sum(-1)
    here, there = (way * normals[:, None]).sum(-1), -(way * facings[None]).sum(-1)
    factor = np.maximum(here, 0) * np.maximum(there, 0) / (squared * (squared + areas / np.pi))
    return factor @ flux


def strip_form_factor(across, width):
    """From a point ``across`` from the edge of two faces, on one, to an endless strip of ``width`` on the other."""
    return 0.5 * (1 - across / np.hypot(across, width))


def look_up_cells(values, surface, stride, key, size, row, col):
    """Bilinear among cells of one surface; None where no cell around the pixel is on it."""
    middles = [np.minimum(np.arange(n) * stride + stride // 2, s - 1) for n, s in zip(values.shape, size, strict=False)]
    spans = []
    for middle, at in zip(middles, (row, col), strict=True):
        place = np.interp(at, middle, np.arange(len(middle)))
        low = int(place)
        spans.append([(low, 1 - (place - low)), (min(low + 1, len(middle) - 1), place - low)])
    cells = [(values[i, j], a * b) for i, a in spans[0] for j, b in spans[1] if surface[i, j] == key]
    if not cells:
        return None
    weights = np.array([weight for _, weight in cells])
    if weights.sum() == 0:
        weights[:] = 1
    return (np.array([value for value, _ in cells]) * weights[:, None]).sum(0) / weights.sum()
