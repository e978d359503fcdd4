"""Float64 twin of ``warp_ar.kernels.environment.bracket``."""

import numpy as np

FLOOR, SHOT = 0.002, 0.0004


def spread_clipping(confidence, clipped, reach):
    """Largest share at clipping within ``reach`` along every row, (K, h, w, 3)."""
    count, height, width, _ = clipped.shape
    spread = np.zeros_like(clipped, np.float64)
    for k in range(count):
        share = np.where(np.isfinite(clipped[k]).all(-1, keepdims=True), clipped[k], 1.0)
        share = np.where((confidence[k] > 0)[..., None], share, 0.0)
        for i in range(height):
            step = 2 * np.pi / width * np.sin((i + 0.5) * np.pi / height)
            columns = min(int(np.ceil(reach / step)), width // 2)
            spread[k, i] = np.max([np.roll(share[i], s, axis=0) for s in range(-columns, columns + 1)], axis=0)
    return spread


def merge_exposures(ratios, radiance, confidence, clipped, spread, reach):
    """Radiance (h, w, 3), confidence (h, w) and share at clipping (h, w, 3); ``ratios`` of 0 are not trusted."""
    count, height, width, _ = radiance.shape
    rows = int(np.ceil(reach * height / np.pi))
    merged, certainty = np.zeros((height, width, 3)), np.zeros((height, width))
    share = np.zeros((height, width, 3))
    for i in range(height):
        near = spread[:, max(i - rows, 0) : i + rows + 1].max(axis=1)
        for j in range(width):
            good = [
                k
                for k in range(count)
                if ratios[k] > 0
                and confidence[k, i, j] > 0
                and np.isfinite(radiance[k, i, j]).all()
                and radiance[k, i, j].min() >= 0
                and np.isfinite(clipped[k, i, j]).all()
            ]
            if not good:
                continue
            certainty[i, j] = min(max(confidence[k, i, j] for k in good), 1.0)
            for c in range(3):
                clear = [k for k in good if near[k, j, c] == 0]
                bound = [radiance[k, i, j, c] / ratios[k] for k in good if clipped[k, i, j, c] > 0]
                if clear:
                    x = np.array([radiance[k, i, j, c] for k in clear])
                    r = np.array([ratios[k] for k in clear])
                    w = np.array([min(confidence[k, i, j], 1.0) for k in clear]) * r**2 / (FLOOR**2 + SHOT * x)
                    merged[i, j, c] = np.average(x / r, weights=w)
                else:
                    merged[i, j, c] = radiance[good[-1], i, j, c] / ratios[good[-1]]
                    share[i, j, c] = clipped[good[-1], i, j, c]
                merged[i, j, c] = max([merged[i, j, c], *bound])
    return merged, certainty, share
