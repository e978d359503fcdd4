"""The files that a scene may name: the one resolver of paths in scene files."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any


@dataclasses.dataclass(frozen=True)
class SceneFiles:
    """Resolver of every path in a scene file, and of the cameras that it may open.

    A scene of the user's own may name any file: ``SceneFiles(folder)``. A scene from outside, such as one dropped onto
    the live page, may name nothing but the files that came with it and those of the scene that is shown: give both as
    ``known``, for example ``SceneFiles.of(folder, [*unpacked, *files_of(shown)], cameras)``. `load_scene` and
    `loads_scene` take it as ``files``; a path that is not among the known files is refused before anything looks at it,
    and no message says where it would lead.
    """

    folder: Path
    """Folder where relative paths start."""
    known: frozenset[Path] | None = None
    """Files and folders that may be named, resolved; None: all."""
    cameras: frozenset[int] | None = None
    """Indices of capture devices that may be named; None: all."""

    names: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    """Files of a scene from outside that it names by their names alone, wherever they lie."""

    @classmethod
    def of(cls, folder: Path, known: Iterable[Path], cameras: Iterable[int] = ()) -> SceneFiles:
        """Return the resolver of a scene from outside.

        Args:
            folder: Folder where its relative paths start.
            known: Files that came with it, and those that the scene that is shown names.
            cameras: Capture devices that are open already.
        """
        return cls(folder.resolve(), frozenset(path.resolve() for path in known), frozenset(cameras))

    def resolve(self, text: str) -> Path | None:
        """Return the path that a scene names, links followed; None if it must not be named.

        Raises:
            OSError: It cannot be a path; so with RuntimeError and ValueError.
        """
        if text in self.names:
            return self.names[text]
        path = (self.folder / text).resolve()
        if self.known is None:
            path.exists()  # a name that is too long for the system is refused here
            return path
        return path if path in self.known else None

    def has_camera(self, index: int) -> bool:
        """Return whether a scene may name a capture device."""
        return self.cameras is None or index in self.cameras


def files_of(value: Any) -> Iterator[Path]:
    """Yield every path that a scene, or a part of one, names."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from files_of(item)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from files_of(getattr(value, field.name))
