"""Float64 twin of the irradiance of a convex object over the plane z = 0 that a camera sees from straight above."""

import numpy as np


def irradiance_over_plane(point, normal, directions, flux, seen, desk):
    """Irradiance of ``normal`` at ``point``: samples that run into the plane show ``desk`` where ``seen(x, y)``.

    Args:
        point: (3,) above the plane.
        normal: (3,) unit.
        directions: (n, 3) of the samples.
        flux: (n,) radiance times solid angle; radiance 1, so that the desk's is a factor.
        seen: Whether the camera sees a point (x, y) of the plane.
        desk: Radiance of the desk.
    """
    weight = np.maximum(directions @ normal, 0) * flux
    down = directions[:, 2] < 0
    t = np.where(down, -point[2] / np.where(down, directions[:, 2], -1), 0)
    at = point + t[:, None] * directions
    return float((weight * np.where(down & seen(at[:, 0], at[:, 1]), desk, 1)).sum())
