"""Poses fitted to a marker's printed edges: the host's side of ``warp_ar.kernels.picture.marker_edge_fit``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from warp_ar.device import start_warp
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.picture import marker_edge_fit
from warp_ar.scene import Camera, Pose
from warp_ar.tracking.markers import Pattern

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Box = tuple[slice, slice]
"""Rows and columns of a picture."""

MOST_REACHES = 8


class EdgeFitter:
    """Fits poses of one print to pictures of one camera; holds the part of a picture that it was shown last, in grey.

    ``gray`` is the whole picture's size; of it only what was shown last means anything.
    """

    def __init__(self, pattern: Pattern, camera: Camera) -> None:
        """Allocate.

        Args:
            pattern: What is printed.
            camera: Of the pictures.
        """
        start_warp()

        def array(values: Any, dtype: Any) -> Any:
            return wp.array(values, dtype=dtype, device="cpu")

        shape = (camera.height, camera.width)
        gray = wp.zeros(shape, dtype=wp.uint8, device="cpu")
        self.gray: Image = gray.numpy()
        printed = marker_edge_fit.Print()
        for name in ("points", "tangents", "normals", "outline", "cells"):
            setattr(printed, name, array(getattr(pattern, name), wp.vec3d))
        for name in ("clearances", "white"):
            setattr(printed, name, array(getattr(pattern, name), wp.float64))
        lens = marker_edge_fit.Lens()
        lens.focal, lens.principal = wp.vec2d(camera.fx, camera.fy), wp.vec2d(camera.cx, camera.cy)
        lens.distortion = marker_edge_fit.vec8d(*np.resize([*camera.distortion, *([0.0] * 8)], 8).tolist())
        asked = wp.zeros(1, dtype=marker_edge_fit.Asked, device="cpu")
        reaches = wp.zeros(MOST_REACHES, dtype=wp.float64, device="cpu")
        fits = wp.zeros(marker_edge_fit.MOST_POSES, dtype=marker_edge_fit.EdgeFit, device="cpu")
        information = wp.zeros((marker_edge_fit.MOST_POSES, 6, 6), dtype=wp.float64, device="cpu")
        linear = array(decode_table(camera.transfer).mean(1), wp.float32)
        # Kept: what the launch refers to.
        self._given = gray, linear, printed, lens, asked, reaches, fits, information
        self._asked, self._reaches, self._fits = asked.numpy(), reaches.numpy(), fits.numpy()
        self._information = information.numpy()
        self._launch: Any = None

    def show(self, image: Image, box: Box) -> Image:
        """Take a part of a picture as the one to fit to.

        Args:
            image: uint8 (height, width, 3) RGB, or (height, width) grey.
            box: The part.

        Returns:
            It in grey; it holds until another is shown.
        """
        rows, columns = box
        part = self.gray[box]
        if image.ndim == 2:
            part[...] = image[box]
        else:
            cv2.cvtColor(image[box], cv2.COLOR_RGB2GRAY, dst=part)
        self._asked[0] = (0, 0, rows.start, rows.stop, columns.start, columns.stop)
        return part

    def fit(self, poses: Sequence[Pose], reaches: Sequence[float]) -> list[Any]:
        """Fit poses to the edges of the part that was shown.

        Args:
            poses: ``MOST_POSES`` or fewer, ``camera_from_world``.
            reaches: Half width of the sampled window in pixels per Gauss-Newton step, ``MOST_REACHES`` or fewer.

        Returns:
            Records of ``EdgeFit``, one for each; they hold until the next call, as does ``information``.
        """
        if self._launch is None:
            self._launch = marker_edge_fit.record_fit_edges(*self._given)
        asked, fits = self._asked, self._fits
        asked["poses"], asked["reaches"] = len(poses), len(reaches)
        self._reaches[: len(reaches)] = reaches
        for fit, pose in zip(fits, poses, strict=False):
            fit["rotation"], fit["translation"] = pose.rotation, pose.translation
        self._launch()
        return list(fits[: len(poses)])

    def information(self, index: int) -> Array:
        """Inverse covariance (6, 6) of rotation vector and translation of a pose of the last call, a copy."""
        return np.array(self._information[index])
