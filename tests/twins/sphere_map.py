"""Float64 twins of ``warp_ar.kernels.environment.sphere_map``, written from OpenGL's formula."""

import numpy as np


def disc(camera_position, world_from_camera, focal, principal, center, radius):
    """Column, row of the ball's centre and its radius in pixels, for a lens without distortion."""
    away = np.asarray(center, float) - camera_position
    p = world_from_camera.T @ away
    size = radius / np.sqrt(away @ away - radius * radius)
    return np.asarray(principal) + np.asarray(focal) * p[:2] / p[2], np.asarray(focal) * size


def bilinear(values, x, y):
    """Samples of (H, W, C) at columns and rows, clamped to the border."""
    height, width = values.shape[:2]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    i1, j1 = np.minimum(i + 1, height - 1), np.minimum(j + 1, width - 1)
    fx, fy = (x - j)[..., None], (y - i)[..., None]
    top = (1 - fx) * values[i, j] + fx * values[i, j1]
    return (1 - fy) * top + fy * ((1 - fx) * values[i1, j] + fx * values[i1, j1])


def texture(radiance, center, radius, size):
    """Level 0: texel centres over the square around the disc."""
    at = (2 * np.arange(size) + 1) / size - 1
    u, v = np.meshgrid(at, at)
    return bilinear(radiance, center[0] + u * radius[0], center[1] + v * radius[1])


def levels(first):
    """All levels: means of 2x2."""
    out = [first]
    while out[-1].shape[0] > 1:
        a = out[-1]
        out.append((a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]) / 4)
    return out


def sphere_mapped(directions, world_from_camera):
    """(s, t) in -1..1 with rows downward, of world directions (..., 3): OpenGL's r / m."""
    d = directions @ world_from_camera  # camera: x right, y down, z forward
    r = np.stack([d[..., 0], -d[..., 1], -d[..., 2]], -1)  # eye: x right, y up, z toward the viewer
    m = 2 * np.sqrt(r[..., 0] ** 2 + r[..., 1] ** 2 + (r[..., 2] + 1) ** 2)
    s, t = r[..., 0] / m + 0.5, r[..., 1] / m + 0.5
    return 2 * s - 1, -(2 * t - 1)


def look_up(level, directions, world_from_camera):
    """Bilinear samples of a level for world directions."""
    u, v = sphere_mapped(directions, world_from_camera)
    size = level.shape[0]
    return bilinear(level, 0.5 * (u + 1) * size - 0.5, 0.5 * (v + 1) * size - 0.5)
