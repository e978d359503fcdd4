"""A scene's table of walks, by which kernels on CPU call them: see ``kernels/rays/called_walks.py``."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_ar.kernels.rays.called_walks import SCENE_AT
from warp_ar.kernels.rays.walks import write_walks
from warp_ar.kernels.structs import RayScene


class WalkTable:
    """Owns the table of one scene on CPU."""

    def __init__(self, detail: bool, stretched: bool) -> None:
        """Have the walks compiled, unless they are in the cache, and where they lie written.

        That is a launch, which may be noted (``kernels.launch.noting``) and done before the first frame.

        Args:
            detail: Whether any object's triangles let rays pass or have normal maps.
            stretched: Whether any object may be stretched.
        """
        words = -(-np.dtype(RayScene.numpy_dtype()).itemsize // 8)
        self._table = wp.zeros(SCENE_AT + words, dtype=wp.uint64, device="cpu")
        write_walks(detail, stretched, self._table)

    @property
    def address(self) -> int:
        """What ``RayScene.walks`` is to be."""
        return int(self._table.ptr)

    def write(self, scene: Any) -> None:
        """Take over what walks read of a ``RayScene``, all but its shapes; whenever that has changed."""
        record = np.array([scene.numpy_value()], dtype=RayScene.numpy_dtype())
        words = self._table.numpy()
        words[SCENE_AT:].view(np.uint8)[: record.nbytes] = record.view(np.uint8)
