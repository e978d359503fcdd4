"""A mesh file and the files that it refers to, checked before they are read.

These files (material library, buffers, textures) may be missing. One may be a pipe that never ends, or a picture whose
header promises more pixels than fit into memory.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import is_file, limits, read_bytes, too_much
from warp_ar.scene.textures import decode_rgba

_CONFINED: Final[set[Path]] = set()
"""Folders registered by ``confine``."""


def confine(folder: Path) -> None:
    """Let mesh files in a folder refer only to files inside it, because untrusted ones could show other files."""
    _CONFINED.add(folder.resolve())


class MeshSource:
    """State while a mesh file is read: its bytes, the files it refers to, and its pictures and notes so far."""

    def __init__(self, path: Path, data: bytes = b"") -> None:
        """Store a file; read none of the files that it refers to yet.

        Args:
            path: Path of the file, or a name for messages if the mesh is in memory.
            data: Contents of the file.
        """
        self.path, self.data = path, data
        self.images: list[npt.NDArray[np.uint8]] = []
        """Pictures that materials refer to, RGBA."""
        self.notes: list[str] = []
        """Descriptions of contents of the file that are not shown."""
        self.known: dict[str, bytes] = {}
        """Contents of files that were read, by their names in the mesh file."""
        self._within = next((folder for folder in _CONFINED if path.resolve().is_relative_to(folder)), None)

    def note(self, words: str) -> None:
        """Note once that a content of the file is not shown."""
        if words not in self.notes:
            self.notes.append(words)

    def check_count(self, count: int, size: int = 0) -> None:
        """Check the number of vertices or faces that a header promises.

        Args:
            count: Number of vertices or faces.
            size: Smallest number of bytes per vertex or face.

        Raises:
            SceneError: The number exceeds the limit, or the file is too short for it.
        """
        if count > limits().mesh_elements:
            raise SceneError(too_much(f"{self.path}", count, "vertices or faces", "mesh_elements"))
        if count * size > len(self.data):
            held = f"the file has {len(self.data):,} bytes"
            raise SceneError(f"{self.path}: its header promises {count:,} elements, and {held}")

    def get(self, name: str, limit: str) -> bytes:
        """Return the contents of a file by its name in the mesh file.

        Args:
            name: The name.
            limit: Field of ``files.Limits`` with the largest number of bytes.

        Raises:
            SceneError: The file is missing, too large, not a regular file, or outside the folder of a confined mesh
                file.
        """
        if name not in self.known:
            path = self._found(name) or self.path.parent / name.strip()
            if not self._reaches(path):
                raise SceneError(f"{self.path}: the file {name[:60]!r}, which it names, does not come with it")
            self.known[name] = read_bytes(path, limit, SceneError, f"{self.path}: {path}, which it names,")
        return self.known[name]

    def picture(self, name: str, *, color: bool = False) -> npt.NDArray[np.uint8]:
        """Return a referenced picture, RGBA; if ``color``, its colours are converted by its ICC profile.

        Raises:
            SceneError: The picture is missing, damaged or too large.
        """
        return decode_rgba(self.get(name, "picture_bytes"), f"{self.path}: {name}, which it names,", color=color)

    def has(self, name: str) -> bool:
        """Return True if a file of that name exists."""
        return self._found(name) is not None

    def _found(self, name: str) -> Path | None:
        plain = name.strip()
        candidates = (plain, plain.replace("\\", "/"), plain.lstrip("/"), re.split(r"[/\\]", plain)[-1])
        paths = (self.path.parent / text for text in candidates)
        return next((path for path in paths if self._reaches(path) and is_file(path)), None)

    def _reaches(self, path: Path) -> bool:
        """Return True if the mesh file is allowed to refer to a path."""
        return self._within is None or path.resolve().is_relative_to(self._within)
