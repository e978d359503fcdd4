"""Colours of a camera, from a photograph of a colour chart with 24 patches.

The chart is found, and its patches are measured, by OpenCV. A matrix A takes linear camera values c of the patches to
their linear sRGB values under D65, s, by least squares: A c = s. Its scale would be that of the chart's light, so A is
multiplied by the green value of the camera's white, A^-1 (1, 1, 1): white keeps its green value.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError

Array = NDArray[np.float64]

GREYS: Final = slice(18, 24)
"""The chart's row of greys."""
CLIPPED: Final = 250.0
"""Mean code from which a patch clips."""
FITS: Final = 0.03
"""Root mean square error, relative to white, up to which a matrix is used: 0.005 by noise, 0.02 if the light changes by
10 % across the chart, 0.025 by a phone's tone curve. The errors of the matrix are about four times as large."""
WRONG: Final = 0.1
"""Root mean square error, relative to white, from which the patches are not a chart's: 0.35 where one was misplaced."""


def measure_chart(image: NDArray[np.uint8], codes: NDArray[np.float32], name: str) -> tuple[Array, str]:
    """Return the matrix from camera values to linear sRGB, (3, 3), by a chart in a photograph, and a note on its fit.

    Args:
        image: uint8 RGB, with the chart evenly lit.
        codes: Linear value of each code, (256, 3).
        name: Name of the photograph in messages.

    Raises:
        UsageError: There is no chart, it clips, or its colours fit no camera.
    """
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(np.ascontiguousarray(image[..., ::-1]), 1):
        raise UsageError(
            f"{name} shows no colour chart; expected one of 24 patches, 150 pixels wide or more, with its rim"
        )
    # Number of pixels, mean, deviation, least and largest code of each channel of each patch.
    seen = np.array(detector.getBestColorChecker().getChartsRGB()).reshape(24, 3, 5)[..., 1]
    if seen.max() >= CLIPPED:
        raise UsageError(f"{name}: the colour chart clips (code {seen.max():.0f}); expose it less")
    linear = np.stack([np.interp(seen[:, k], np.arange(256), codes[:, k]) for k in range(3)], 1)
    model: Any = cv2.ccm.ColorCorrectionModel(linear[:, None], cv2.ccm.COLORCHECKER_MACBETH)
    model.setLinearization(cv2.ccm.LINEARIZATION_IDENTITY)
    model.setDistance(cv2.ccm.DISTANCE_RGBL)
    matrix = np.array(model.compute()).T
    true = np.array(model.getRefLinearRGB()).reshape(24, 3)
    error = float(np.sqrt(((linear @ matrix.T - true) ** 2).mean()))
    if error > WRONG:
        right = "show it whole, evenly lit and without glare"
        raise UsageError(f"{name}: the colours of the chart fit no camera (off by {error:.0%} of white); {right}")
    note = f"the colour chart of {name} fits within {error:.1%} of white"
    if error > FITS:
        # Each grey counts by its hue alone, so that uneven light does not matter.
        white, grey = (
            (part / np.maximum(part.sum(1, keepdims=True), 1e-9)).mean(0) for part in (true[GREYS], linear[GREYS])
        )
        matrix = np.diag(white / grey)
        note += "; only its greys are used, for the white balance: is it evenly lit?"
    return matrix * np.linalg.inv(matrix)[1].sum(), note
