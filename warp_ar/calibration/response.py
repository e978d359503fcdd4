"""Response curve of a camera from pictures of one still scene at several exposures.

A response file is text: 256 lines of three numbers, the linear red, green and blue value of each 8-bit code, 1 for code
255; a line that begins with # is a comment.

References:
    [DM97] P. Debevec and J. Malik. Recovering high dynamic range radiance maps from photographs. SIGGRAPH 1997.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.files import write_whole
from warp_ar.signature import PROGRAM

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


def measure_response(images: Sequence[Image], exposures: Sequence[float]) -> Array:
    """Linear value of each 8-bit code, from pictures of one still scene at several exposure times [DM97].

    Args:
        images: RGB uint8 pictures of one size, taken without moving the camera.
        exposures: their exposure times in seconds; only ratios matter.

    Returns:
        (256, 3) red, green and blue, rising, 1 at code 255.

    Raises:
        UsageError: if there are too few pictures, they differ in size, or exposures are impossible.
    """
    if len(images) < 3 or len(images) != len(exposures):
        raise UsageError(
            f"{len(images)} pictures and {len(exposures)} exposures; expected one for each, and three or more"
        )
    if len({image.shape for image in images}) > 1:
        raise UsageError("pictures of different sizes; expected one still camera")
    if not all(math.isfinite(e) and e > 0 for e in exposures) or max(exposures) < 2 * min(exposures):
        raise UsageError(
            f"exposures {', '.join(f'{e:g}' for e in exposures)}: expected times above 0 that differ by 2 or more"
        )
    # More samples than OpenCV's 70, and smoother than its 10: 8-bit noise must not bend the curve.
    calibrate = cv2.createCalibrateDebevec(samples=300, lambda_=50.0, random=False)
    curve = np.asarray(calibrate.process(list(images), np.asarray(exposures, np.float32)), float).reshape(256, 3)
    if not np.isfinite(curve).all() or (curve <= 0).any():
        raise UsageError(
            "the exposures do not determine a response: are all pictures of one scene, neither black nor white?"
        )
    # Noise at the ends may bend the curve down; a response only rises.
    curve = np.maximum.accumulate(curve, axis=0)
    curve -= curve[0]
    if (curve[-1] <= 0).any():
        raise UsageError("the pictures do not differ: expected one scene at several exposures")
    return np.asarray(curve / curve[-1], float)


def write_response(curve: Array, path: Path) -> None:
    """Write a response as text: 256 lines of three linear values.

    Raises:
        SinkError: if the file cannot be written.
    """
    try:
        text = f"# {PROGRAM}\n" + "".join(f"{r:.9g} {g:.9g} {b:.9g}\n" for r, g, b in curve)
        write_whole(path, text.encode())
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {reason(error)}") from error
