"""Names of what a scene holds, for files that tell others about it."""

from __future__ import annotations

import re

from warp_ar.scene.description import Scene
from warp_ar.scene.object_shapes import object_shapes, shape_label


def surface_names(scene: Scene) -> tuple[str, ...]:
    """A name for every surface, in the order of the layer ``ids``: virtual objects, proxies, mirror balls.

    Letters, digits and underscores, each name once: ``object_0_bunny`` by its file or its shape, ``proxy_1_plane``. Of
    an object whose file moves it in parts, each part has a name: ``object_0_truck``, ``object_0_truck_part_1``.
    """
    objects = map(shape_label, object_shapes(scene))
    proxies = (f"proxy_{k}_{one.file.stem if one.file else one.shape}" for k, one in enumerate(scene.proxies))
    balls = (f"ball_{k}" for k in range(len(scene.probes)))
    return tuple(re.sub(r"\W", "_", name, flags=re.ASCII) for name in (*objects, *proxies, *balls))
