"""A mesh file, and the files that it names, looked at before they are read.

A material library, a buffer or a texture may be a pipe that never ends, a picture whose header promises more pixels
than fit into memory, or missing.
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
"""Folders of ``confine``."""


def confine(folder: Path) -> None:
    """Let mesh files in a folder name files in it only: they are not trusted, and would show what lies elsewhere."""
    _CONFINED.add(folder.resolve())


class MeshSource:
    """A mesh file while it is read: its bytes, files beside it or relative to it, and what they hold so far."""

    def __init__(self, path: Path, data: bytes = b"") -> None:
        """Take a file; nothing that it names is read yet.

        Args:
            path: The file, or what messages call a mesh in memory.
            data: Its bytes.
        """
        self.path, self.data = path, data
        self.images: list[npt.NDArray[np.uint8]] = []
        """Pictures that materials name, RGBA."""
        self.notes: list[str] = []
        """Parts of the file that are not shown, in words."""
        self.known: dict[str, bytes] = {}
        """Files that were read, by the names that the mesh file has for them."""
        self._within = next((folder for folder in _CONFINED if path.resolve().is_relative_to(folder)), None)

    def note(self, words: str) -> None:
        """Say of something, once, that it is not shown."""
        if words not in self.notes:
            self.notes.append(words)

    def check_count(self, count: int, size: int = 0) -> None:
        """Check how many vertices or faces a header promises.

        Args:
            count: Number of them.
            size: Least number of bytes that each takes.

        Raises:
            SceneError: It is more than may be read, or than the file can hold.
        """
        if count > limits().mesh_elements:
            raise SceneError(too_much(f"{self.path}", count, "vertices or faces", "mesh_elements"))
        if count * size > len(self.data):
            held = f"the file has {len(self.data):,} bytes"
            raise SceneError(f"{self.path}: its header promises {count:,} elements, and {held}")

    def get(self, name: str, limit: str) -> bytes:
        """Return the bytes of a file by the name that the mesh file has for it.

        Args:
            name: The name.
            limit: Field of ``files.Limits`` that says how many there may be.

        Raises:
            SceneError: It is missing, too large or no regular file, or the mesh file may not name it.
        """
        if name not in self.known:
            path = self._found(name) or self.path.parent / name.strip()
            if not self._reaches(path):
                raise SceneError(f"{self.path}: the file {name[:60]!r}, which it names, does not come with it")
            self.known[name] = read_bytes(path, limit, SceneError, f"{self.path}: {path}, which it names,")
        return self.known[name]

    def picture(self, name: str, *, color: bool = False) -> npt.NDArray[np.uint8]:
        """Return a picture that it names, RGBA; arguments as those of `decode_rgba`.

        Raises:
            SceneError: It is missing, damaged or too large.
        """
        return decode_rgba(self.get(name, "picture_bytes"), f"{self.path}: {name}, which it names,", color=color)

    def has(self, name: str) -> bool:
        """Return whether there is a file of a name."""
        return self._found(name) is not None

    def _found(self, name: str) -> Path | None:
        plain = name.strip()
        candidates = (plain, plain.replace("\\", "/"), plain.lstrip("/"), re.split(r"[/\\]", plain)[-1])
        paths = (self.path.parent / text for text in candidates)
        return next((path for path in paths if self._reaches(path) and is_file(path)), None)

    def _reaches(self, path: Path) -> bool:
        """Return whether the file may name another one there."""
        return self._within is None or path.resolve().is_relative_to(self._within)
