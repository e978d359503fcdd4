"""One table of a scene file, as the readers of its sections take it."""

from __future__ import annotations

from typing import cast

from warp_ar.scene.description import Marker
from warp_ar.scene.materials import RGB, Color
from warp_ar.scene.table import Table


class SceneTable(Table):
    """One table of a scene file."""

    world: Marker | None = None
    """The world's marker, if there is one."""

    def reflectance(self, key: str, default: Color) -> Color:
        """A colour from 0 to 1, or the path of a texture."""
        value = self.data.get(key, default)
        if isinstance(value, str):
            return self.file(key, "a picture")
        if not isinstance(value, list | tuple):
            self.fail(key, "expected a list of 3 numbers from 0 to 1, or the path of a texture")
        return cast(RGB, self.vector(key, cast(RGB, default), low=0.0, high=1.0))
