"""A video file that grows by whole fragments, whatever happens: a full disk, a signal, another file in its place."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from warp_ar.files import create_new, name_aside, take_name

_MEDIA = {True: b"mdat", False: b"\x1f\x43\xb6\x75"}
"""What pictures begin with: a box of MP4, a cluster of Matroska."""
_SEEK_SIZE = 0x10000
"""FFmpeg's way to ask for the size of a file."""


class WholeFragments:
    """What FFmpeg writes a video through, as if it were a file.

    The file is made aside and takes its name with its first fragment, so that what stood there stays until then.
    Boxes of MP4 and MOV (a fragment is two, ``moof`` and ``mdat``) are kept back until they are complete and written at
    once; one that does not fit onto the disk is cut off again. Matroska, whose readers take a cut-off end for the end,
    is written as it comes. What goes wrong is kept in ``error``, for FFmpeg goes on all the same.
    """

    def __init__(self, path: Path, *, boxes: bool) -> None:
        """Make the file.

        Args:
            path: Its name at last.
            boxes: Whether it is made of boxes, as MP4 and MOV are.

        Raises:
            OSError: It cannot be made.
        """
        self._path, self._boxes = Path(os.path.realpath(path)), boxes
        part = name_aside(self._path)
        self._part: Path | None = part
        try:
            self._file = create_new(part)
        except BaseException:  # a signal, when the file may be there already
            with contextlib.suppress(OSError):
                part.unlink()
            raise
        self._pending = bytearray()
        self._start = self._size = self._at = 0  # of what is pending; of the file; where FFmpeg is
        self._closed = False
        self.error: OSError | None = None
        """What ended the writing; nothing has been written since."""

    def write(self, data: bytes) -> int:
        """Take bytes at the current place."""
        if self.error is not None:
            return len(data)
        if self._at != self._start + len(self._pending):
            self._flush(everything=True)
            self._start = self._at
        self._pending += data
        self._at += len(data)
        self._flush(everything=not self._boxes or self._start < self._size)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a place, or tell the size."""
        size = max(self._size, self._start + len(self._pending))
        if whence == _SEEK_SIZE:
            return size
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: size}[whence]
        return self._at

    def tell(self) -> int:
        """Where FFmpeg is."""
        return self._at

    def read(self, size: int = -1) -> bytes:
        """What stands at the current place: FFmpeg reads back what it finishes."""
        self._flush(everything=True)
        data = os.pread(self._file, max(self._size - self._at, 0) if size < 0 else size, self._at)
        self._at += len(data)
        return data

    def _flush(self, *, everything: bool) -> None:
        length = len(self._pending) if everything else _whole_boxes(self._pending)
        if not length:
            return
        data = bytes(self._pending[:length])
        try:
            written = 0
            while written < length:
                written += os.pwrite(self._file, data[written:], self._start + written)
        except OSError as error:
            self.error = error
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._size)
            return
        del self._pending[:length]
        self._start += length
        self._size = max(self._size, self._start)
        if self._part is not None and (_MEDIA[self._boxes] in data):
            # Where an open file cannot be renamed, it takes its name when it is closed.
            with contextlib.suppress(PermissionError):
                take_name(self._part, self._path)
                self._part = None

    def close(self) -> None:
        """Write what is left and let the file go; one that holds nothing is removed."""
        if self._closed:
            return
        self._closed = True
        if self.error is None:
            self._flush(everything=True)
        own = os.fstat(self._file)
        os.close(self._file)
        try:
            if self._part is not None and self._size and self.error is None:
                take_name(self._part, self._path)
            elif self._part is not None:
                self._part.unlink(missing_ok=True)
            elif not os.path.samestat(own, os.stat(self._path)):
                raise OSError("another file took its name while it was written, as by a second run with this output")
        except FileNotFoundError:
            self.error = self.error or OSError("it, or its folder, was removed while it was written")
        except OSError as error:
            self.error = self.error or error


def _whole_boxes(data: bytearray) -> int:
    """Bytes of complete boxes at the start; a ``moof`` waits for the ``mdat`` behind it."""
    at = whole = 0
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        kind = bytes(data[at + 4 : at + 8])
        if size == 1 and at + 16 <= len(data):
            size = int.from_bytes(data[at + 8 : at + 16], "big")
        if size < 8 or at + size > len(data):
            break
        at += size
        if kind != b"moof":
            whole = at
    return whole
