"""Which cells of the frame are estimated, with and without a queue of rays, and how pixels are filtered from them."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.environment_shadow_rig import ONE_BALL, SUM_ERROR, draw, lamp_at, run, shadow_cells, sphere, with_sun
from tests.gltf_files import Gltf
from tests.kernel_rig import records, shape
from tests.relight_rig import CAMERA, DESK, LOOK_DOWN, POINTS, RAYS, H, W
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.objects.reflect import DistantLightConfig
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.receiver import environment_shadow_filter
from warp_ar.kernels.receiver.environment_shadow import EnvironmentShadowConfig
from warp_ar.kernels.structs import BOX, LAMBERT, PLANE, FrameParams, RayScene, Shape
from warp_ar.scene import Camera as SceneCamera
from warp_ar.scene import Object, Scene

pytestmark = pytest.mark.slow

# --- Cells ------------------------------------------------------------------------------------------------------------


def test_queued_rays_find_the_same(device):
    """By one kernel or by three: with a box, a ball and a lamp at a place, all of which may be before the objects."""
    drawn = draw(with_sun(6, 20, 100.0))
    environment_samples.place_emitters(lamp_at((0.1, 0.05, 0.4)), ONE_BALL, drawn[2])
    scene = {
        "objects": [sphere((0, 0, 0.05), 0.05), shape(BOX, (-0.1, -0.1, 0.03), (0.03, 0.02, 0.03))],
        "proxies": (DESK, shape(BOX, (-0.12, 0.08, 0.04), (0.03, 0.04, 0.04))),
        "probes": [{"center": (0.1, 0, 0.03), "radius": 0.03, "reflectance": (0.8, 0.7, 0.6)}],
        "stride": 2,
        "bounce": "traced",
        "secondary": 0.5,
        "albedo": 0.5,
        "emitters": True,
    }
    one = run(drawn, **scene)
    assert one.min() < 0.7
    found = run(drawn, **scene, partials=8, queued=True)
    np.testing.assert_allclose(found, one, atol=SUM_ERROR)
    np.testing.assert_array_equal(run(drawn, **scene, partials=8, queued=True), found)
    dark = run(drawn, **{**scene, "albedo": 0.0}, partials=8, queued=True)
    assert (dark[one < 0.99] < one[one < 0.99]).mean() > 0.5, "objects send light"


def test_what_is_seen_from_one_side_hides_the_sky_from_both(device, tmp_path):
    """A sheet above the desk that faces up: rays of the desk come from behind it."""
    drawn = draw(with_sun(6, 20, 100.0))
    made = Gltf()
    made.material()
    made.node(made.square(0))
    # A file's square stands upright and faces -y, toward whoever looks along +y.
    sheet = Object(
        "mesh", file=made.save(tmp_path / "sheet.glb"), at=(0.0, 0.0, 0.03), rotate=(-90.0, 0.0, 0.0), scale=0.05
    )
    about = {
        "loaded": Scene(SceneCamera(W, H, 60, 60, W / 2, H / 2), objects=(sheet,)),
        "stride": 2,
        "bounce": "traced",
        "secondary": 0.5,
        "filtered": False,
    }
    expected, _ = run(drawn, **about)
    assert (expected < 0.5).mean() > 0.02
    for way in ({}, {"queued": True, "partials": 8}):
        ratio, _ = run(drawn, **about, single_sided=1, **way)
        np.testing.assert_allclose(ratio, expected, atol=SUM_ERROR)


ON_DESK = EnvironmentShadowConfig(
    DistantLightConfig(TraceConfig((), (PLANE,)), (LAMBERT,), False, "none", False, False), 64, 4, "estimated"
)


def filtered_cells(ratio, surface, side=4):
    cells = shadow_cells(surface.shape)
    cells.ratio.assign(np.asarray(ratio, np.float32))
    cells.surface.assign(surface.astype(np.int32))
    config = dataclasses.replace(ON_DESK, side=side)
    environment_shadow_filter.filter_ratio(config, cells)
    return cells.filtered.numpy()


def test_filter_keeps_surfaces_apart(device):
    ratio = np.ones((16, 16, 4), np.float32)
    ratio[:, 8:, :3] = 0.25
    surface = np.zeros((16, 16), np.int32)
    surface[:, 8:] = 8
    surface[3, :] = -1
    out = filtered_cells(ratio, surface)
    expected = np.where(surface == 0, 1.0, 0.25)[..., None].repeat(3, -1)
    expected[3] = 0.0
    np.testing.assert_array_equal(out, expected)


def filtered(ratio, side=4):
    """What ``filter_ratio`` makes of one channel."""
    cells = np.repeat(np.asarray(ratio, np.float32)[..., None], 4, -1)
    return filtered_cells(cells, np.zeros(cells.shape[:2]), side)[..., 0]


def test_what_no_picture_shows_is_exactly_one(device):
    value = np.ones((24, 24), np.float32)
    value[:, 12:] = 1 - 0.9 * environment_shadow_filter.NEGLIGIBLE
    assert (filtered(value) == 1).all()
    value[:, 12:] = 1 - 1.1 * environment_shadow_filter.NEGLIGIBLE
    assert (filtered(value)[:, 14:] != 1).all()


def test_pixels_between_surfaces_find_their_own(device):
    # A board above the desk, dark, and the desk around it, unshaded: no pixel takes the other's ratio.
    board = shape(PLANE, (0.003, 0.004, 0.1), (0.083, 0.061, 0))
    params = records(
        FrameParams, {"camera_position": CAMERA, "world_from_camera": LOOK_DOWN, "shadow_rect": (0, H, 0, W)}
    )
    scene = RayScene()
    scene.proxies = records(Shape, DESK, board)
    stride = 4
    meets = CAMERA + (POINTS - CAMERA) * (0.6 - 0.1) / 0.6
    on_board = (np.abs(meets[..., :2] - (0.003, 0.004)) <= (0.083, 0.061)).all(-1)
    middle = on_board[stride // 2 :: stride, stride // 2 :: stride]
    averaged = shadow_cells(middle.shape, stride)
    averaged.surface = wp.array(np.where(middle, 8, 0), dtype=wp.int32)
    averaged.filtered = wp.array(np.where(middle, 0.25, 1.0)[..., None].repeat(3, -1), dtype=wp.vec3)
    out, rays = wp.zeros((H, W), wp.vec3), wp.array(RAYS, dtype=wp.vec2)
    environment_shadow_filter.spread_ratio(ON_DESK, params, rays, scene, None, averaged, out)
    np.testing.assert_array_equal(out.numpy()[..., 0], np.where(on_board, 0.25, 1.0))
