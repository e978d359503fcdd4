"""Kernels that any scene shares give the pictures of those that are made for one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages.shared import lighting


@pytest.mark.parametrize(("name", "quality"), [("wire_coincident", "low"), ("torus", "medium")])
def test_a_shared_kernel_gives_the_same_picture(monkeypatch: pytest.MonkeyPatch, name: str, quality: str) -> None:
    """In all bits: what a scene lacks adds zeros and multiplies by one."""
    scene = load_scene(name)
    with open_source(scene.source.path) as source:
        images = [frame.image.copy() for frame in itertools.islice(source, 3)]
    lit = []
    for shared in (True, False):
        monkeypatch.setattr(lighting, "shares_kernels", lambda device, shared=shared: shared)
        for stage in ("mirror_ball", "unwrap"):
            monkeypatch.setattr(f"warp_ar.stages.{stage}.shares_kernels", lambda device, shared=shared: shared)
        with Pipeline(scene, device="cpu", quality=quality, estimates="synchronous") as pipeline:
            lit.append([pipeline(image, time_seconds=k / 24.0).image for k, image in enumerate(images)])
    np.testing.assert_array_equal(lit[0], lit[1])
    assert any((shown != image).any() for shown, image in zip(lit[0], images, strict=True)), "nothing was lit"


def test_a_variable_decides_for_all_devices(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    target = wp.get_device(device)
    monkeypatch.delenv(lighting.VARIABLE, raising=False)
    assert lighting.shares_kernels(target) == target.is_cpu
    for value, shared in (("shared", True), ("specialised", False)):
        monkeypatch.setenv(lighting.VARIABLE, value)
        assert lighting.shares_kernels(target) == shared
    monkeypatch.setenv(lighting.VARIABLE, "general")
    with pytest.raises(UsageError, match="WARP_AR_KERNELS = 'general': expected shared or specialised"):
        lighting.shares_kernels(target)
