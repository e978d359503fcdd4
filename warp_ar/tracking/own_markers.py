"""Markers that objects, lights, proxies and mirror balls ride on, beside the one that the world is fixed to.

Each marker or board is followed on its own, as the world's is. What rides on one stands where its marker is in the
world: with the camera's poses from both, world_from_marker = world_from_camera camera_from_marker.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import Camera, Light, Marker, Object, Pose, Probe, Proxy, Scene
from warp_ar.tracking.tracking import Tracker

Places = Mapping[Marker, Pose | None]
"""``world_from_marker`` of each marker, None where it is lost."""


def own_markers(scene: Scene) -> tuple[Marker, ...]:
    """Markers that anything of a scene rides on, each once."""
    items: tuple[Object | Light | Proxy | Probe, ...] = (*scene.objects, *scene.lights, *scene.proxies, *scene.probes)
    return tuple(dict.fromkeys(item.marker for item in items if item.marker is not None))


class OwnMarkers:
    """Follows every marker that something rides on."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        """Follow the markers of a scene.

        Args:
            scene: Whose objects, lights, proxies and balls ride on them.
            camera: Of the frames.
        """
        self._trackers = {marker: Tracker(marker, camera) for marker in own_markers(scene)}

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._trackers)

    def track(self, image: NDArray[np.uint8], time: float, camera_from_world: Pose | None) -> Places:
        """Where the markers are in the world; all are lost where the world is.

        Args:
            image: (h, w, 3) RGB of 8 bits.
            time: Seconds.
            camera_from_world: By the world's own marker, or known from elsewhere.
        """
        found = {marker: tracker.track(image, time).pose for marker, tracker in self._trackers.items()}
        if camera_from_world is None:
            return dict.fromkeys(found)
        world = camera_from_world.inverse()
        return {marker: None if pose is None else world.after(pose) for marker, pose in found.items()}
