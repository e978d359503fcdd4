"""FLIP [ANAM20]: the difference seen by an observer who alternates between two pictures, 0 to 1 per pixel.

References:
    [ANAM20] Andersson, Nilsson, Akenine-Moeller, Oskarsson, Astroem, Fairchild, "FLIP: A Difference Evaluator for
        Alternating Images", HPG 2020.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import import_extra

Array = npt.NDArray[Any]

CHANGED = 0.02
"""Smallest blurred difference, relative to full scale, for which a pixel counts as changed by virtual content."""
BLUR = 3.0
"""Standard deviation in pixels of the blur of differences, which suppresses noise."""
REACH = 9
"""Side in pixels of the square by which changed regions are dilated."""
CLIPPED_CODE = 254
"""8-bit code from which a channel counts as clipped."""
FLIP_REACH = 32
"""Distance in pixels around differing pixels within which FLIP is computed; its filters reach 10 pixels or less."""


def flip_map(reference: Array, test: Array) -> npt.NDArray[np.float32]:
    """Return FLIP of every pixel, (height, width), 0 to 1; it is computed only near differing pixels.

    Args:
        reference: uint8 RGB (height, width, 3).
        test: Picture of the same shape and type.

    Raises:
        UsageError: The package flip-evaluator is not installed.
    """
    errors = np.zeros(reference.shape[:2], np.float32)
    differs = (reference != test).any(-1)
    if not differs.any():
        return errors
    box = tuple(
        slice(max(int(where[0]) - FLIP_REACH, 0), int(where[-1]) + FLIP_REACH + 1)
        for where in (np.flatnonzero(differs.any(axis)) for axis in (1, 0))
    )
    errors[box] = _evaluate_flip(reference[box], test[box])
    return errors


def _evaluate_flip(reference: Array, test: Array) -> npt.NDArray[np.float32]:
    """Return FLIP of every pixel by its authors' program."""
    flip_evaluator = import_extra("tradeoff", "FLIP needs flip-evaluator", "flip_evaluator")
    pictures = (np.asarray(picture, np.float32) / 255.0 for picture in (reference, test))
    errors = flip_evaluator.evaluate(*pictures, "LDR", applyMagma=False)[0]
    return np.asarray(errors, np.float32).reshape(reference.shape[:2])


def changed_region(camera: Array, truth: Array) -> npt.NDArray[np.bool_]:
    """Return a mask of the pixels in which the truth differs from the camera's frame beyond noise; both uint8 RGB."""
    difference = np.abs(camera.astype(np.float32) - truth.astype(np.float32)).max(-1) / 255.0
    blurred = cv2.GaussianBlur(difference, (0, 0), BLUR)
    widened = cv2.dilate((blurred > CHANGED).astype(np.uint8), np.ones((REACH, REACH), np.uint8))
    return np.asarray(widened > 0)


def clipped_region(camera: Array) -> npt.NDArray[np.bool_]:
    """Return a mask of the pixels of a uint8 RGB frame in which some channel clips."""
    return np.asarray((camera >= CLIPPED_CODE).any(-1))
