"""Resolver of paths in scene files, which limits the files that an untrusted scene may refer to."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any


@dataclasses.dataclass(frozen=True)
class SceneFiles:
    """Resolver of all paths in a scene file, and of the capture devices that it may open.

    The user's own scene may refer to any file: ``SceneFiles(folder)``. An untrusted scene, for example one dropped onto
    the live page, may refer only to files that came with it and to files of the scene that is shown. Give both as
    ``known``, for example ``SceneFiles.of(folder, [*unpacked, *files_of(shown)], cameras)``, and pass the result to
    `load_scene` or `loads_scene` as ``files``. A path that is not among the known files is refused before the file
    system is accessed, and no message tells where it points.
    """

    folder: Path
    """Folder where relative paths start."""
    known: frozenset[Path] | None = None
    """Allowed files and folders, resolved; None: all."""
    cameras: frozenset[int] | None = None
    """Allowed indices of capture devices; None: all."""

    names: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    """Files of an untrusted scene, by file name, wherever they are stored."""

    @classmethod
    def of(cls, folder: Path, known: Iterable[Path], cameras: Iterable[int] = ()) -> SceneFiles:
        """Return the resolver for an untrusted scene.

        Args:
            folder: Folder where its relative paths start.
            known: Files that came with the scene, and files of the scene that is shown.
            cameras: Indices of capture devices that are already open.
        """
        return cls(folder.resolve(), frozenset(path.resolve() for path in known), frozenset(cameras))

    def resolve(self, text: str) -> Path | None:
        """Return a path of the scene with links resolved; None if it is not allowed.

        Raises:
            OSError: The text is not a valid path; RuntimeError and ValueError are raised for the same reason.
        """
        if text in self.names:
            return self.names[text]
        path = (self.folder / text).resolve()
        if self.known is None:
            path.exists()  # refuses names that are too long for the system
            return path
        return path if path in self.known else None

    def has_camera(self, index: int) -> bool:
        """Return True if a scene may use a capture device."""
        return self.cameras is None or index in self.cameras


def files_of(value: Any) -> Iterator[Path]:
    """Yield every path in a scene or in a part of it."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from files_of(item)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from files_of(getattr(value, field.name))
