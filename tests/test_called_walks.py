"""Walks that kernels call by their address: they find what walks find that a kernel holds, bit by bit."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import warp as wp

from tests.gltf_files import Gltf
from warp_ar import scene as scenes
from warp_ar.kernels.launch import noting
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import ALL_KINDS, BY_CALL, TraceConfig, make_trace
from warp_ar.kernels.structs import Hit, RayScene
from warp_ar.scene.ray_scene import HostScene
from warp_ar.scene.walk_table import WalkTable

CAMERA = scenes.Camera(width=64, height=48, fx=600.0, fy=620.0, cx=30.5, cy=24.0)
PROXIES = (
    scenes.Proxy("plane", size=(3.0, 3.0)),
    scenes.Proxy("box", size=(0.4, 0.4, 0.4), at=(0.3, 0.5, 0.1), rotate=(0.0, 0.0, 25.0)),
)
RAYS = 4000
WALKS = ((False, False), (True, True))
"""Walks through plain triangles, and through those that let rays pass, may be stretched and have normal maps."""


@functools.cache
def make_find_kernel(config: TraceConfig) -> wp.Kernel:
    """Kernel that asks every function of ``make_trace``."""
    trace = make_trace(config)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    by_objects, by_proxies, by_any = trace.occluded_by_objects, trace.occluded_by_proxies, trace.occluded

    @wp.kernel(enable_backward=False, module="unique")
    def find_kernel(
        # In:
        scene: RayScene,
        origins: wp.array[wp.vec3],
        directions: wp.array[wp.vec3],
        reach: wp.float32,
        # Out:
        hits_out: wp.array2d[Hit],
        hidden_out: wp.array2d[wp.bool],
    ):
        i = wp.tid()
        hits_out[i, 0] = closest_object(scene, origins[i], directions[i], FAR)
        hits_out[i, 1] = closest_proxy(scene, origins[i], directions[i], FAR)
        hidden_out[i, 0] = by_objects(scene, origins[i], directions[i], reach)
        hidden_out[i, 1] = by_proxies(scene, origins[i], directions[i], reach)
        hidden_out[i, 2] = by_any(scene, origins[i], directions[i], reach)

    return find_kernel


@pytest.fixture(scope="module")
def some_scene(tmp_path_factory) -> scenes.Scene:
    """A shape of each kind, and a square that is cut out and let through by its picture."""
    made = Gltf()
    rng = np.random.default_rng(3)
    texture = made.texture(rng.integers(0, 256, (16, 16, 4)).astype(np.uint8))
    bumps = made.texture(rng.integers(96, 160, (16, 16, 3)).astype(np.uint8))
    made.material(
        pbrMetallicRoughness={"baseColorTexture": {"index": texture}},
        normalTexture={"index": bumps},
        alphaMode="BLEND",
        doubleSided=True,
    )
    made.node(made.square(0))
    objects = (
        scenes.Object("sphere", radius=0.2, at=(0.5, 0.0, 0.3)),
        scenes.Object("box", size=(0.2, 0.4, 0.6), at=(-0.5, 0.1, 0.3), rotate=(10.0, 20.0, 30.0)),
        scenes.Object("torus", major_radius=0.3, minor_radius=0.1, at=(0.0, -0.5, 0.3)),
        scenes.Object("mesh", file=made.save(tmp_path_factory.mktemp("square") / "square.glb"), at=(0.0, 0.6, 0.3)),
    )
    return scenes.Scene(CAMERA, objects=objects, proxies=PROXIES)


def find(config, host):
    """Hits of random rays through the middle of the scene, and what is hidden."""
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(RAYS, 3))
    origins *= 2.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.normal(scale=0.5, size=(RAYS, 3)) - origins
    hits = wp.zeros((RAYS, 2), dtype=Hit, device="cpu")
    hidden = wp.zeros((RAYS, 3), dtype=wp.bool, device="cpu")
    rays = [wp.array(values.astype(np.float32), dtype=wp.vec3, device="cpu") for values in (origins, directions)]
    wp.launch(make_find_kernel(config), RAYS, [host.ray_scene, *rays, 1.0], [hits, hidden], device="cpu")
    return hits.numpy(), hidden.numpy()


def assert_same(found, expected):
    for name in found[0].dtype.names:
        np.testing.assert_array_equal(found[0][name], expected[0][name], err_msg=name)
    np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize(("detail", "stretched"), WALKS)
def test_called_walks_find_what_held_ones_find(some_scene, detail, stretched):
    host = HostScene(some_scene, wp.get_device("cpu"))
    table = WalkTable(detail, stretched)
    table.write(host.ray_scene)
    host.ray_scene.walks = table.address
    found = find(TraceConfig(BY_CALL, BY_CALL), host)
    assert_same(found, find(TraceConfig(ALL_KINDS, ALL_KINDS, detail, stretched), host))
    assert {*found[0]["shape"][:, 0]} == {-1, 0, 1, 2, 3}
    assert {*found[0]["shape"][:, 1]} == {-1, 0, 1}
    hidden = found[1].mean(axis=0)
    assert (hidden > 0.02).all()
    assert (hidden < 0.98).all()


def test_a_scene_chooses_its_walks(some_scene):
    """One kernel: of two scenes, one whose square lets rays pass and one without it."""
    plain = scenes.Scene(CAMERA, objects=some_scene.objects[:3], proxies=PROXIES)
    for scene, detail in ((some_scene, True), (plain, False), (some_scene, True)):
        host = HostScene(scene, wp.get_device("cpu"))
        expected = find(TraceConfig(ALL_KINDS, ALL_KINDS, detail, False), host)
        assert_same(find(TraceConfig((), ()).general(by_call=True), host), expected)


def test_walks_know_the_angle_of_a_pixel(some_scene):
    """Rays pass a blended square by cells about a pixel wide."""
    host = HostScene(some_scene, wp.get_device("cpu"))
    before = find(TraceConfig(BY_CALL, BY_CALL), host)
    host.set_pixel_spread(0.1)
    after = find(TraceConfig(BY_CALL, BY_CALL), host)
    assert_same(after, find(TraceConfig(ALL_KINDS, ALL_KINDS, True, False), host))
    assert (before[0]["shape"] != after[0]["shape"]).any()


def test_walks_may_be_loaded_later(some_scene):
    """Where launches are noted, a scene's walks are compiled with other kernels and then found."""
    with noting() as notes:
        host = HostScene(some_scene, wp.get_device("cpu"))
    (note,) = notes
    assert note.kernel is not None
    assert note.kernel.key.endswith("walks_kernel")
    note.do()
    assert (find(TraceConfig(BY_CALL, BY_CALL), host)[0]["shape"] >= 0).any()


def test_rays_through_nothing_call_nothing():
    """A scene without shapes needs no table."""
    host = HostScene(scenes.Scene(CAMERA), wp.get_device("cpu"))
    expected = find(TraceConfig(ALL_KINDS, ALL_KINDS), host)
    host.ray_scene.walks = 0
    found = find(TraceConfig(BY_CALL, BY_CALL), host)
    assert_same(found, expected)
    assert (found[0]["shape"] == -1).all()
    assert not found[1].any()
