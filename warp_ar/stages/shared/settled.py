"""The environment as its readers last heard of it."""

from __future__ import annotations

from typing import Any

from warp_ar.stages.base import Arrays

PUBLISHED = ("recover_published", "fill_published")
"""Copies that the stage which writes ``environment`` makes on CPU whenever it says that it changed; the last first."""


def settled_environment(arrays: Arrays, device: Any) -> Any:
    """The map that filters read: its contents change with the version of ``environment``, and only then.

    On CPU ``environment`` itself also moves within the tolerance that its readers are spared. A filter that rested
    while nobody read it must give what it would have given then, not what it makes of a map that has moved on since. On
    CUDA every new map is a new version.
    """
    if device.is_cpu:
        for name in PUBLISHED:
            if name in arrays:
                return arrays[name]
    return arrays["environment"]
