"""Copy of the environment whose contents change only with its version."""

from __future__ import annotations

from typing import Any

from warp_ar.stages.base import Arrays

PUBLISHED = ("recover_published", "fill_published")
"""Copies that the writer of ``environment`` makes on CPU when it reports a change; the later stage's first."""


def settled_environment(arrays: Arrays, device: Any) -> Any:
    """Return the map for filters: its contents change only with the version of ``environment``.

    On CPU ``environment`` itself also changes within the tolerance of which readers are not notified. A filter that
    rested while nothing read it must give the result that it would have given then, and not that of a map that has
    changed since. On CUDA every new map has a new version.
    """
    if device.is_cpu:
        for name in PUBLISHED:
            if name in arrays:
                return arrays[name]
    return arrays["environment"]
