"""Whether modelled walls and boxes lie where the picture shows edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.checks.finding import Finding
from warp_ar.checks.outline_fit import refit_outline
from warp_ar.scene import Camera, Pose, Scene

Image = NDArray[np.uint8]

MOVED: Final = 5.0
"""Pixels by which a corner must be off: of a box that is right, 0.6."""
ON: Final = 0.55
"""Share of a shape's outline on edges of the picture from which on it is right: of a box that is, 0.7."""
BETTER: Final = 0.15
"""Share of the outline by which more of it must lie on edges elsewhere: one that is off along itself keeps 0.4."""
FEWEST: Final = 2
"""Views that must agree, or all where there are fewer."""


def check_proxies(scene: Scene, camera: Camera, views: Sequence[tuple[Image, Pose]]) -> list[Finding]:
    """Findings about boxes that stand on the desk, and walls, whose edges the picture has elsewhere."""
    found = []
    for index, proxy in enumerate(scene.proxies):
        fits = [refit for image, pose in views if (refit := refit_outline(image, camera, pose, proxy)) is not None]
        worse = [fit for fit in fits if fit.moved > MOVED and fit.met_before < ON and fit.met > fit.met_before + BETTER]
        if not worse or len(worse) < max(1, min(FEWEST, len(views))):
            continue
        off = np.median([np.subtract(fit.proxy.at, proxy.at)[:2] for fit in worse], axis=0)
        x, y = np.add(proxy.at[:2], off)
        shown = np.median([fit.met_before for fit in worse])
        text = (
            f"[[proxy]] {index}: {shown:.0%} of the {proxy.shape}'s outline lies on edges of the picture, which has it "
            f"{1e3 * float(np.hypot(*off)):.0f} mm away"
        )
        remedy = f"point it out anew in the page, or write at = [{x:.3f}, {y:.3f}, {proxy.at[2]:g}]"
        found.append(Finding("proxy.edges", text, remedy))
    return found
