"""Frames as numbered PNGs of 8 or 16 bits, or as OpenEXRs of linear radiance."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import SinkError, reason
from warp_ar.exr_file import write_exr
from warp_ar.files import kind_of, write_whole
from warp_ar.output.places import earlier_frames
from warp_ar.output.sink import ThreadedSink, check_radiance, make_folder
from warp_ar.output.video_sink import VIDEO_SUFFIXES
from warp_ar.signals import REC_709
from warp_ar.signature import PROGRAM, sign_png

HALF_MAX = 65504.0
"""Largest number of 16 bits."""

FOLDER_THREADS = 2
"""Threads that compress the frames of a folder."""

# Camera frames hardly repeat, so looking for repetitions costs time and saves no byte; neighbours are alike.
PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
)


class FolderSink(ThreadedSink):
    """A folder of ``NNNN.png``, numbered from 0; other files in it are left alone.

    A frame appears under its name only when it is whole. Numbered frames that stood there go with the first new one, so
    that what the folder holds is of one run.

    Args:
        path: The folder.
        overwrite: Whether numbered frames that this program did not write may go.

    Raises:
        SinkError: The folder cannot be made or written to, or holds frames that may not go.
    """

    _suffix = ".png"

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False) -> None:
        self._path = pathlib.Path(path)
        try:
            kind = kind_of(self._path)
        except OSError as error:
            raise SinkError(f"{self._path} cannot be written to: {reason(error)}") from error
        if kind not in ("folder", "nothing"):
            what = "a file" if kind == "file" else kind
            raise SinkError(f"{self._path} is {what}; name a folder, or a video ending in {', '.join(VIDEO_SUFFIXES)}")
        make_folder(self._path)
        self._earlier: list[pathlib.Path] = []
        self._find_earlier(self._path, self._suffix, overwrite=overwrite)
        self.description = f"{self._path} (numbered frames)"
        super().__init__(FOLDER_THREADS)

    def _find_earlier(self, folder: pathlib.Path, suffix: str, *, overwrite: bool) -> None:
        """Note the numbered frames that the first new one replaces; raises SinkError where they may not go."""
        self._earlier += earlier_frames(folder, suffix, overwrite=overwrite)
        if self._earlier:
            self.replaced = f"{self._path}: {len(self._earlier)} numbered frames of an earlier run are replaced"

    def write(self, image: Any) -> None:
        """Take the next frame; the first one clears away those of an earlier run.

        Raises:
            SinkError: It is no frame, another frame could not be written, or an earlier run's cannot be replaced.
        """
        self._check(image)
        earlier, self._earlier = self._earlier, []
        # The last first: who is killed meanwhile leaves the beginning of the earlier run, all parts of its frames.
        for path in reversed(earlier):
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise SinkError(f"{path} cannot be replaced: {reason(error)}") from error
        super().write(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        _write_png(self._path / f"{index:04d}.png", image)


class DeepPngSink(FolderSink):
    """A folder of ``NNNN.png`` of 16 bits: linear radiance in the codes of the camera.

    Args:
        path: The folder.
        overwrite: Whether numbered frames that this program did not write may go.
        transfer: The camera's.

    Raises:
        SinkError: As for `FolderSink`.
    """

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False, transfer: str = "srgb") -> None:
        super().__init__(path, overwrite=overwrite)
        self._transfer = transfer
        self.description = f"{self._path} (numbered frames of 16 bits)"

    def _check(self, image: Any) -> None:
        check_radiance(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        from warp_ar.kernels.color import encode_codes  # here, for it loads Warp: the page is to be there before

        codes = np.rint(65535.0 * encode_codes(self._transfer, image)).astype(np.uint16)
        _write_png(self._path / f"{index:04d}.png", codes)


class RadianceSink(FolderSink):
    """A folder of ``NNNN.exr``: linear radiance, channels R, G, B of 16-bit floats, Rec. 709's primaries.

    Args:
        path: The folder.
        overwrite: Whether numbered frames that this program did not write may go.

    Raises:
        SinkError: As for `FolderSink`.
    """

    _suffix = ".exr"

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False) -> None:
        super().__init__(path, overwrite=overwrite)
        self.description = f"{self._path} (numbered OpenEXRs)"

    def _check(self, image: Any) -> None:
        check_radiance(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "software": PROGRAM,
            "chromaticities": REC_709,
        }
        half = np.clip(image, -HALF_MAX, HALF_MAX).astype(np.float16)
        channels = {name: np.ascontiguousarray(half[..., k]) for k, name in enumerate("RGB")}
        path = self._path / f"{index:04d}.exr"
        _write(path, functools.partial(write_exr, image=OpenEXR.File(header, channels)))


def _write_png(path: pathlib.Path, image: npt.NDArray[Any]) -> None:
    """Write RGB codes of 8 or 16 bits, signed."""
    ok, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), PNG_OPTIONS)
    if not ok:
        raise SinkError(f"{path} cannot be encoded as PNG")
    _write(path, sign_png(data.tobytes()))


def _write(path: pathlib.Path, data: Any) -> None:
    try:
        write_whole(path, data)
    except (OSError, RuntimeError) as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
