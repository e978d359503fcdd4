"""Distances between results: numbers for arrays, FLIP for pictures.

Errors of arrays are relative to the reference's own size, so that they compare across scenes and exposures:

    relative RMSE  = sqrt(sum w |x - r|^2 / sum w |r|^2)
    worst          = max |x - r| / sqrt(mean w |r|^2)
    energy drift   = sum w x / sum w r - 1

with weights w, for latlong maps the texels' solid angles. FLIP [ANAM20] is the difference that an observer sees who
flips between two pictures, 0 to 1 per pixel.

References:
    [ANAM20] Andersson, Nilsson, Akenine-Moeller, Oskarsson, Astroem, Fairchild, "FLIP: A Difference Evaluator for
        Alternating Images", HPG 2020.
"""

from __future__ import annotations

import collections
import dataclasses
import hashlib
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError

Array = npt.NDArray[Any]

CHANGED = 0.02
"""Smallest difference, of full scale, that counts as changed by something virtual."""
BLUR = 3.0
"""Standard deviation in pixels of the blur before that: noise does not count."""
REACH = 9
"""Side in pixels by which changed regions are widened."""
CLIPPED_CODE = 254
"""Code from which a channel counts as clipped."""
FLIP_REACH = 32
"""Pixels beyond which a difference changes FLIP nowhere: its filters reach 10, and those of their borders less."""
KEPT_BYTES = 128 << 20
"""Of maps of FLIP that were asked for last: reports ask for a picture's errors more than once."""
_kept_maps: collections.OrderedDict[bytes, npt.NDArray[np.float32]] = collections.OrderedDict()


@dataclasses.dataclass(frozen=True)
class ArrayError:
    """Distances of an array from its reference."""

    relative_rmse: float
    """Root mean square error over root mean square of the reference."""
    worst: float
    """Largest error of one element over root mean square of the reference."""
    energy_drift: float
    """Sum over the reference's sum, less 1."""


def array_error(values: Array, reference: Array, weights: Array | None = None) -> ArrayError:
    """Compare an array with its reference.

    Args:
        values: Any shape.
        reference: The same shape.
        weights: Broadcast against the first axes of ``reference``; None means 1.

    Raises:
        ValueError: The shapes differ, or a value is not finite.
    """
    if values.shape != reference.shape:
        raise ValueError(f"values have the shape {values.shape}, their reference {reference.shape}")
    x, r = np.asarray(values, np.float64), np.asarray(reference, np.float64)
    if not (np.isfinite(x).all() and np.isfinite(r).all()):
        raise ValueError("values and their reference must be finite")
    w = np.ones(r.shape) if weights is None else np.asarray(weights, np.float64)
    w = np.broadcast_to(w.reshape(w.shape + (1,) * (r.ndim - w.ndim)), r.shape)
    total = w.sum()
    size = float(np.sqrt((w * r * r).sum() / total)) if total > 0.0 else 0.0
    difference = float(np.sqrt((w * (x - r) ** 2).sum() / total)) if total > 0.0 else 0.0
    energy = float((w * r).sum())
    return ArrayError(
        _ratio(difference, size),
        _ratio(float(np.abs(x - r).max(initial=0.0)), size),
        _ratio(float((w * x).sum()) - energy, energy),
    )


def _ratio(a: float, b: float) -> float:
    """A over b; nothing over nothing is 0."""
    if a == 0.0:
        return 0.0
    return a / b if b != 0.0 else float(np.copysign(np.inf, a))


def latlong_weights(height: int, width: int) -> npt.NDArray[np.float64]:
    """Solid angle of every texel of a latlong map, (height, width); they sum to 4 pi."""
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return np.repeat(((edges[:-1] - edges[1:]) * 2.0 * np.pi / width)[:, None], width, axis=1)


def flip_map(reference: Array, test: Array) -> npt.NDArray[np.float32]:
    """FLIP of every pixel, (height, width), 0..1; not to be written to.

    Args:
        reference: uint8 RGB (height, width, 3).
        test: The same shape and type.

    Raises:
        UsageError: The package flip-evaluator is not installed.
    """
    key = hashlib.blake2b(repr(reference.shape).encode())
    for picture in (reference, test):
        key.update(picture.tobytes())
    found = _kept_maps.get(key.digest())
    if found is None:
        found = _compute_flip(reference, test)
        found.flags.writeable = False
        _kept_maps[key.digest()] = found
        while sum(kept.nbytes for kept in _kept_maps.values()) > max(KEPT_BYTES, found.nbytes):
            _kept_maps.popitem(last=False)
    _kept_maps.move_to_end(key.digest())
    return found


def _compute_flip(reference: Array, test: Array) -> npt.NDArray[np.float32]:
    """FLIP, computed where the pictures differ: elsewhere it is 0."""
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
    """FLIP of every pixel by its authors' program."""
    try:
        import flip_evaluator  # only what measures pictures needs it
    except ImportError as error:
        raise UsageError('FLIP needs the package flip-evaluator: pip install "warp-ar[tradeoff]"') from error
    pictures = (np.asarray(picture, np.float32) / 255.0 for picture in (reference, test))
    errors = flip_evaluator.evaluate(*pictures, "LDR", applyMagma=False)[0]
    return np.asarray(errors, np.float32).reshape(reference.shape[:2])


def changed_region(camera: Array, truth: Array) -> npt.NDArray[np.bool_]:
    """Pixels in which the truth differs from the camera's frame beyond noise; both uint8 RGB of one shape."""
    difference = np.abs(camera.astype(np.float32) - truth.astype(np.float32)).max(-1) / 255.0
    blurred = cv2.GaussianBlur(difference, (0, 0), BLUR)
    widened = cv2.dilate((blurred > CHANGED).astype(np.uint8), np.ones((REACH, REACH), np.uint8))
    return np.asarray(widened > 0)


def clipped_region(camera: Array) -> npt.NDArray[np.bool_]:
    """Pixels of a uint8 RGB frame in which some channel clips."""
    return np.asarray((camera >= CLIPPED_CODE).any(-1))
