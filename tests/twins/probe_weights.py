"""Float64 twin of ``warp_ar.kernels.environment.probe_weights``."""

import numpy as np

TRUST_TIME, ENOUGH, SEEN_AT_ALL = 0.4, 0.5, 0.02


def weights(places, point):
    """Normalised weights of balls (x, y, z, trust) at a point."""
    places = np.asarray(places, np.float64)
    found = []
    for i, mine in enumerate(places):
        bands = [1.0]
        for j, other in enumerate(places):
            across = other[:3] - mine[:3]
            if i != j and across @ across > 0.0:
                t = np.clip((np.asarray(point, np.float64) - mine[:3]) @ across / (across @ across), 0.0, 1.0)
                bands.append(1.0 - other[3] * t)
        found.append(mine[3] * min(bands))
    total = sum(found)
    return np.array(found) / total if total > 0.0 else np.eye(len(places))[0]


def update_places(places, shares, centers, seconds):
    """Places and trusts after a frame that shows these shares of balls at these centres."""
    places = np.asarray(places, np.float64).copy()
    fresh = not places[:, 3].any()
    for place, share, center in zip(places, shares, centers, strict=True):
        if fresh or share > SEEN_AT_ALL:
            place[:3] = center
        target = min(share / ENOUGH, 1.0)
        place[3] = target if fresh else place[3] + (1.0 - np.exp(-seconds / TRUST_TIME)) * (target - place[3])
    most = places[:, 3].max()
    if most > 0.0:
        places[:, 3] /= most
    return places
