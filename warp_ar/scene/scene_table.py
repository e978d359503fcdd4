"""One table of a scene file, as the readers of its sections take it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self, cast

from warp_ar.scene.description import Marker
from warp_ar.scene.materials import RGB, Color
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.table import Table


class SceneTable(Table):
    """One table of a scene file."""

    world: Marker | None = None
    """The world's marker, if there is one."""

    def __init__(self, label: str, files: SceneFiles, section: str, data: object, keys: Sequence[str]) -> None:
        """Check the keys; arguments and errors as those of `Table`, with the resolver of paths for the folder."""
        super().__init__(label, files.folder, section, data, keys)
        self.files = files

    def inner(self, key: str, data: object, keys: Sequence[str]) -> Self:
        """Return a table within this one: the value of a key."""
        return type(self)(self.label, self.files, self.name(key), data, keys)

    def find(self, text: str) -> Path | None:
        """Return the path that a text names; None if this scene must not name it."""
        return self.files.resolve(text)

    def reflectance(self, key: str, default: Color) -> Color:
        """A colour from 0 to 1, or the path of a texture."""
        value = self.data.get(key, default)
        if isinstance(value, str):
            return self.file(key, "a picture")
        if not isinstance(value, list | tuple):
            self.fail(key, "expected a list of 3 numbers from 0 to 1, or the path of a texture")
        return cast(RGB, self.vector(key, cast(RGB, default), low=0.0, high=1.0))
