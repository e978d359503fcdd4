"""Generated clips, the same in every run."""

from __future__ import annotations

import math
from collections.abc import Generator

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.sources.source import DEFAULT_FPS, Frame, RecordedSource

Image = npt.NDArray[np.uint8]


class Synthetic(RecordedSource):
    """Generated clip, the same in every run.

    ``card`` is a marker seen by a moving camera, with ground truth in `pose` and `camera_matrix`. The marker is number
    0 of ``DICT_4X4_50``; its black square is ``MARKER_SIZE`` metres wide.

    Args:
        name: ``card``.
        size: (width, height) in pixels.
        fps: Frames per second.
        length: Number of frames.
        loop: Start again at the end.

    Raises:
        UsageError: There is no such clip.
    """

    MARKER_SIZE = 0.08

    def __init__(
        self,
        name: str = "card",
        *,
        size: tuple[int, int] = (640, 480),
        fps: float = DEFAULT_FPS,
        length: int = 96,
        loop: bool = False,
    ) -> None:
        super().__init__(loop=loop)
        if name != "card":
            raise UsageError(f"there is no synthetic source {name!r}; did you mean card?")
        self.name, self.size, self.fps, self.length = name, size, fps, length
        self.description = f"synthetic {name} ({size[0]}x{size[1]}, {length} frames)"

    @property
    def camera_matrix(self) -> npt.NDArray[np.float64]:
        """Return the pinhole camera matrix of ``card``, (3, 3), in pixels with centres at integers."""
        width, height = self.size
        focal = 0.9 * width
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])

    def pose(self, index: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return rotation R (3, 3) and translation t (3,) of frame ``index`` of ``card``, ``camera_from_world``.

        A point X of the marker's frame, in metres, is R X + t in the camera's frame (x right, y down).
        """
        phase = 2 * math.pi * index / (self.length or 1)
        flip = np.diag([1.0, -1.0, -1.0])
        tilt = cv2.Rodrigues(np.array([math.radians(-35 + 8 * math.sin(phase)), 0.0, 0.0]))[0]
        spin = cv2.Rodrigues(np.array([0.0, 0.0, math.radians(15 * math.cos(phase))]))[0]
        return flip @ tilt @ spin, np.array([0.03 * math.sin(phase), 0.02 * math.cos(phase), 0.35])

    def _decode(self) -> Generator[Frame, None, None]:
        for index in range(self.length or 0):
            yield Frame(index, index / self.fps, self._draw(index))

    def _draw(self, index: int) -> Image:
        cells, pixels, scale = 6, 32, 2
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        marker = np.pad(cv2.aruco.generateImageMarker(dictionary, 0, cells * pixels), 2 * pixels, constant_values=240)
        metres, middle = self.MARKER_SIZE / (cells * pixels), (marker.shape[0] - 1) / 2
        world_from_texel = np.array([[metres, 0, -middle * metres], [0, -metres, middle * metres], [0, 0, 1]])
        rotation, translation = self.pose(index)
        pixel_from_world = self.camera_matrix @ np.column_stack([rotation[:, :2], translation])
        # The picture is drawn at twice the resolution and averaged. Pixel x covers the fine pixels 2 x and 2 x + 1, so
        # that its centre is at the fine coordinate 2 x + 1/2.
        fine_from_pixel = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        width, height = self.size
        fine = cv2.warpPerspective(
            marker,
            fine_from_pixel @ pixel_from_world @ world_from_texel,
            (scale * width, scale * height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=120,
        )
        grey = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8))
