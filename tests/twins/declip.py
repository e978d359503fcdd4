"""Float64 twins of ``warp_ar.kernels.picture.declip``."""

import numpy as np

DARKEST, LEAST_HUE, BRIGHTEST, KNEE, CLIPPED, TILE = 0.25, 1.0 / 64.0, 1.0e4, 250, 254, 16


def weighted_hue(radiance, known):
    """Hue (mean 1) times weight, and the weight; (H, W, 4)."""
    w = np.where(known, np.clip((radiance.max(-1) - DARKEST) / (1.0 - DARKEST), 0.0, 1.0) ** 2, 0.0)[..., None]
    mean = np.where(w > 0.0, radiance.mean(-1, keepdims=True), 1.0)
    return np.concatenate([w * radiance / mean, w], -1)


def coarser(values):
    """Sums of 2x2 blocks; those at odd borders are smaller."""
    height, width = values.shape[:2]
    padded = np.pad(values, ((0, height % 2), (0, width % 2), (0, 0)))
    return sum(padded[i::2, j::2] for i in (0, 1) for j in (0, 1))


def finer(values, shape):
    """Bilinear, texel centres at half-integers, the border's value beyond the border."""
    for axis in (0, 1):
        at = np.clip(0.5 * np.arange(shape[axis]) - 0.25, 0.0, values.shape[axis] - 1.0)
        low = at.astype(int)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        weight = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = np.take(values, low, axis) * (1.0 - weight) + np.take(values, high, axis) * weight
    return values


def fill(sums, levels=0):
    """Hue and levels climbed at the level of ``sums``; the one texel of the last level is completed by grey."""
    if max(sums.shape[:2]) == 1 and levels > 0:
        above = np.array([1.0, 1.0, 1.0, 0.0])
    else:
        above = finer(fill(coarser(sums), levels + 1), sums.shape[:2])
    weight = sums[..., 3:]
    known = np.minimum(weight, 1.0)
    own = known / np.where(weight > 0.0, weight, 1.0) * sums[..., :3]
    return np.concatenate([own + (1.0 - known) * above[..., :3], (1.0 - known) * (above[..., 3:] + 1.0)], -1)


def active_pixels(frame):
    """Pixels of tiles in which something clips, and of their neighbours."""
    height, width = frame.shape[:2]
    tiles = np.zeros((-(-height // TILE) + 2, -(-width // TILE) + 2), bool)
    for i, j in np.argwhere((frame > KNEE).any(-1)):
        tiles[i // TILE : i // TILE + 3, j // TILE : j // TILE + 3] = True
    return np.kron(tiles[1:-1, 1:-1], np.ones((TILE, TILE), bool))[:height, :width]


def declip(frame, linear):
    """Radiance by hue and depth, without the ball, and where it holds."""
    ramp = np.clip((frame.astype(float) - KNEE) / (CLIPPED - KNEE), 0.0, 1.0)
    clipped, active = ramp > 0.0, active_pixels(frame)
    some, core = clipped.any(-1), clipped.all(-1)
    hue = np.maximum(fill(weighted_hue(linear, ~some & active))[..., :3], LEAST_HUE)
    k = (linear * ~clipped).sum(-1) / np.where(core, 1.0, (hue * ~clipped).sum(-1))
    guess = np.minimum(np.maximum(k[..., None] * hue, linear), BRIGHTEST)
    out = np.where(core[..., None], linear, linear + ramp * (guess - linear))
    filled = fill(weighted_hue(out, ~core & active))
    hue = np.maximum(filled[..., :3], LEAST_HUE)
    edge = hue / hue.min(-1, keepdims=True)
    growth = 1.0 - 2.0 ** (-0.5 * filled[..., 3:])
    guess = np.maximum(edge * 2.0**growth, 1.0)
    return np.where(core[..., None], linear + ramp * (guess - linear), out), active
