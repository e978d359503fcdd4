"""Float64 twin of ``kernels/receiver/coverage.py``: counts samples of every pixel at an edge."""

import numpy as np

from tests.twins import surfaces


def offsets(count):
    """Places of the samples of a pixel, in pixels from its centre: n-rooks in both axes."""
    side = round(count**0.5)
    cells = [(k % side, k // side) for k in range(count)]
    return [(((a + (b + 0.5) / side) / side - 0.5), ((b + (side - 0.5 - a) / side) / side - 0.5)) for a, b in cells]


def shares(scene, proxy_rotation, pose, seconds, index, samples):
    """Share of every surface in every pixel, (H, W, surfaces)."""
    height, width = index.shape
    count = len(scene.objects) + len(scene.proxies) + len(scene.probes)
    padded = np.pad(index, 1, mode="edge")
    around = [padded[a : a + height, b : b + width] for a in range(3) for b in range(3)]
    edge = np.any([other != index for other in around], axis=0)
    found = np.zeros((height, width, count))
    for offset in offsets(samples):
        rays = surfaces.directions(scene.camera, pose, offset)
        seen = surfaces.find(scene, proxy_rotation, pose, seconds, rays)[0].reshape(height, width)
        for k in range(count):
            found[..., k] += (seen == k) / samples
    inside = np.stack([index == k for k in range(count)], -1)
    return np.where(edge[..., None], found, inside)
