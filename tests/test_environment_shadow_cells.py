"""Which cells of the frame are estimated, on CPU and by wavefronts, and how pixels are filtered from them."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.environment_shadow_rig import (
    MEAN_ERROR,
    SET_ERROR,
    SUM_ERROR,
    draw,
    lamp_at,
    run,
    shadow_cells,
    sky,
    sphere,
    with_sun,
)
from tests.gltf_files import Gltf
from tests.kernel_rig import records, shape
from tests.relight_rig import CAMERA, DESK, LOOK_DOWN, POINTS, RAYS, H, W
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.receiver import environment_shadow, environment_shadow_filter, environment_shadow_wavefront
from warp_ar.kernels.receiver.environment_shadow_cells import (
    EnvironmentShadowConfig,
    cell_column,
    tiled_cell,
    tiled_shape,
)
from warp_ar.kernels.structs import (
    BOX,
    LAMBERT,
    PLANE,
    SPHERE,
    FrameParams,
    RayScene,
    Shape,
    make_picture,
)
from warp_ar.scene import Camera as SceneCamera
from warp_ar.scene import Object, Scene

# --- Cells ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_bands_of_rows_and_rectangles(device, stride):
    drawn = draw(with_sun(6, 20, 100.0))
    item = [sphere((0, 0, 0.05), 0.05)]
    whole = run(drawn, item, stride=stride)
    assert whole.min() < 0.6
    rect = (7, 31, 12, 50)
    part = run(drawn, item, stride=stride, rect=rect)
    inside = np.zeros((H, W), bool)
    inside[7:31, 12:50] = True
    np.testing.assert_array_equal(part[inside], whole[inside])
    assert (part[~inside] == 1).all()
    assert (run(drawn, item, stride=stride, rect=(0, 0, 0, 0)) == 1).all()


@pytest.mark.parametrize("secondary", [1.0, 0.5])
@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_a_wavefront_finds_the_same(device, bounce, secondary):
    """By one kernel or by four: with a box, a ball and a lamp at a place, all of which may be before the objects."""
    drawn = draw(with_sun(6, 20, 100.0))
    environment_samples.place_emitters(lamp_at((0.1, 0.05, 0.4)), drawn[2])
    scene = {
        "objects": [sphere((0, 0, 0.05), 0.05), shape(BOX, (-0.1, -0.1, 0.03), (0.03, 0.02, 0.03))],
        "proxies": (DESK, shape(BOX, (-0.12, 0.08, 0.04), (0.03, 0.04, 0.04))),
        "probes": [{"center": (0.1, 0, 0.03), "radius": 0.03, "reflectance": (0.8, 0.7, 0.6)}],
        "stride": 2,
        "bounce": bounce,
        "secondary": secondary,
        "albedo": 0.5,
        "emitters": True,
    }
    one = run(drawn, **scene)
    assert one.min() < 0.7
    for partials in (2, 8):
        found = run(drawn, **scene, partials=partials, as_wavefront=True)
        np.testing.assert_allclose(found, one, atol=SUM_ERROR)
        np.testing.assert_array_equal(run(drawn, **scene, partials=partials, as_wavefront=True), found)
    dark = run(drawn, **{**scene, "albedo": 0.0}, partials=8, as_wavefront=True)
    assert (dark[one < 0.99] < one[one < 0.99]).mean() > 0.5, "objects send light"


@pytest.mark.parametrize("secondary", [1.0, 0.5])
def test_what_is_seen_from_one_side_hides_the_sky_from_both(device, tmp_path, secondary):
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
        "secondary": secondary,
        "filtered": False,
    }
    expected, _ = run(drawn, **about)
    assert (expected < 0.5).mean() > 0.02
    for way in ({}, {"as_wavefront": True, "partials": 4}):
        ratio, _ = run(drawn, **about, single_sided=1, **way)
        np.testing.assert_allclose(ratio, expected, atol=SUM_ERROR)


def test_the_first_pass_of_a_wavefront_reads_samples_alone_and_the_next_two_not_each_other(device, monkeypatch):
    """So they may begin before the light is filtered, and run side by side."""
    wavefront = environment_shadow_wavefront

    def in_another_order(config, given, cells, wave):
        samples_alone = DistantLight()
        samples_alone.probes = given[3].probes
        bare = make_picture(wp.zeros((1, 1), dtype=wp.vec3ub), given[1].decode_table, given[1].rays)
        wavefront.find_occluded(config, (given[0], bare, given[2], samples_alone, given[4]), cells, wave)
        for one in (wavefront.trace_secondary, wavefront.sum_light, wavefront.reduce_partials):
            one(config, given, cells, wave)

    drawn = draw(with_sun(6, 20, 100.0))
    environment_samples.place_emitters(lamp_at((0.1, 0.05, 0.4)), drawn[2])
    ball = {"center": (0.1, 0, 0.03), "radius": 0.03, "reflectance": (0.8, 0.7, 0.6)}
    for bounce in ("estimated", "traced"):
        scene = {"objects": [sphere((0, 0, 0.05), 0.05)], "probes": [ball], "bounce": bounce, "emitters": True}
        scene |= {"albedo": 0.5, "partials": 4, "as_wavefront": True}
        whole = run(drawn, **scene)
        with monkeypatch.context() as patch:
            patch.setattr(environment_shadow, "shade_wavefront", in_another_order)
            np.testing.assert_array_equal(run(drawn, **scene), whole)
        assert whole.min() < 0.7


def test_a_wavefront_takes_one_set_and_little_memory(device):
    forms = DistantLightConfig(TraceConfig((SPHERE,), (PLANE,)), (LAMBERT,), False, "none", False, False)

    def wavefront(count, partials, secondary=1.0, size=(10, 20)):
        config = EnvironmentShadowConfig(forms, count, 4, "traced", secondary, partials=partials)
        return environment_shadow_wavefront.make_wavefront(config, *size, device)

    found = wavefront(64, 4, 0.5)
    assert (found.occluded.shape, found.queue.shape) == ((4, 10, 20), (10 * 20 * 32,))
    assert wavefront(64, 1) is None, "more samples than a word has bits"
    assert wavefront(128, 8) is None, "more than a set"
    assert wavefront(64, 2, size=(1080, 1920)) is None, "too much memory"


@wp.kernel(enable_backward=False)
def _columns_kernel(side: wp.int32, lanes: wp.int32, out: wp.array[wp.int32]):
    thread = wp.tid()
    out[thread] = cell_column(thread, out.shape[0], side, lanes)


@pytest.mark.parametrize("columns", [5, 128, 300, 640])
def test_every_column_has_a_thread(device, columns):
    for lanes in (1, 32):
        out = wp.zeros(columns, wp.int32)
        wp.launch(_columns_kernel, columns, [4, lanes], [out])
        taken = out.numpy()
        np.testing.assert_array_equal(np.sort(taken), np.arange(columns))
        whole = taken[: columns // (4 * lanes) * 4 * lanes].reshape(-1, lanes)
        assert (whole % 4 == whole[:, :1] % 4).all(), "a warp's cells are of one set"


@wp.kernel(enable_backward=False)
def _tiles_kernel(side: wp.int32, columns: wp.int32, out: wp.array2d[wp.vec2i]):
    i, thread = wp.tid()
    out[i, thread] = tiled_cell(i, thread, side, columns)


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (135, 240), (16, 32)])
def test_every_cell_has_a_thread_in_a_tile(device, size):
    for side in (1, 2, 4):
        threads = tiled_shape(*size, side)
        out = wp.zeros(threads, wp.vec2i)
        wp.launch(_tiles_kernel, threads, [side, threads[1]], [out])
        taken = out.numpy().reshape(-1, 2)
        every = np.stack(np.meshgrid(*map(np.arange, threads), indexing="ij"), -1).reshape(-1, 2)
        np.testing.assert_array_equal(taken[np.lexsort(taken.T[::-1])], every)
        assert (np.array(threads) >= size).all()
        warps = taken.reshape(-1, 32, 2)
        assert (warps % side == warps[:, :1] % side).all(), "a warp's cells are of one set"
        assert (np.ptp(warps, axis=1) == [3 * side, 7 * side]).all()


def test_half_resolution_agrees(device):
    drawn = draw(sky(1.0))
    item = [sphere((0, 0, 0.09), 0.05)]
    full, half = run(drawn, item), run(drawn, item, stride=2)
    assert np.abs(full - half).max() < SET_ERROR
    assert abs((full - half).mean()) < MEAN_ERROR


def test_bands_agree_with_the_whole(device):
    drawn = draw(sky(1.0))
    item = [sphere((0, 0, 0.09), 0.05)]
    whole, key = run(drawn, item, filtered=False)
    for rows in ((0, 13), (13, H)):
        part, part_key = run(drawn, item, filtered=False, rows=rows)
        np.testing.assert_array_equal(part[slice(*rows)], whole[slice(*rows)])
        np.testing.assert_array_equal(part_key[slice(*rows)], key[slice(*rows)])


ON_DESK = EnvironmentShadowConfig(
    DistantLightConfig(TraceConfig((), (PLANE,)), (LAMBERT,), False, "none", False, False), 64, 4, "estimated"
)


def filtered_cells(ratio, surface, side=4):
    cells = shadow_cells(surface.shape, notes=False)
    cells.ratio.assign(np.asarray(ratio, np.float32))
    cells.surface.assign(surface.astype(np.int32))
    config = dataclasses.replace(ON_DESK, side=side)
    environment_shadow_filter.filter_ratio(config, records(FrameParams, {}), cells)
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


def test_filter_weights_every_set_alike(device):
    # Each set has its own value; away from borders the mean of all is exact wherever the window lies.
    rows, columns = np.mgrid[:24, :24]
    value = 1 + 1e-3 * ((rows % 4) * 4 + columns % 4)
    np.testing.assert_allclose(filtered(value)[2:-2, 2:-2], 1.0075, rtol=1e-6)


def test_filter_narrows_where_that_makes_a_difference(device):
    # An edge between two even halves: only the cells at the edge are blurred.
    edge = np.full((24, 24), 0.2)
    edge[:, 12:] = 0.8
    expected = np.where(np.arange(24) < 12, 0.2, 0.8)
    got = filtered(edge)[8]
    np.testing.assert_allclose(np.delete(got, [11, 12]), np.delete(expected, [11, 12]), atol=1e-6)
    assert 0.35 <= got[11] <= 0.425
    weak = np.full((24, 24), 0.5)
    weak[:, 12:] += 0.5 * environment_shadow_filter.CONTRAST
    assert np.ptp(filtered(weak)[8, 10:14]) < np.ptp(filtered(weak, side=2)[8, 10:14])
    # A mean of 16 cells has half the noise of a mean of 4: where cells differ by chance, few of the latter are picked.
    noise = 0.5 + np.random.default_rng(0).normal(0, 0.1, (96, 96))
    wide, narrow = (filtered(noise, side=side)[4:-4, 4:-4].std() for side in (4, 2))
    assert wide < 0.8 * narrow


def test_what_no_picture_shows_is_exactly_one(device):
    value = np.ones((24, 24), np.float32)
    value[:, 12:] = 1 - 0.9 * environment_shadow_filter.NEGLIGIBLE
    assert (filtered(value) == 1).all()
    value[:, 12:] = 1 - 1.1 * environment_shadow_filter.NEGLIGIBLE
    assert (filtered(value)[:, 14:] != 1).all()


def test_spread_is_a_ramp(device):
    # Cells hold the row and column of the pixel that they were estimated at: between them a ramp has no step, no shift.
    for stride in (1, 2, 3, 4):
        cells = (9, 12)
        size = (cells[0] * stride, cells[1] * stride)
        axes = [np.arange(n) * stride + stride // 2 for n in cells]
        values = np.stack([*np.meshgrid(*axes, indexing="ij"), np.zeros(cells)], -1).astype(np.float32)
        params = records(FrameParams, {"shadow_rect": (0, size[0], 0, size[1])})
        out, rays = wp.zeros(size, wp.vec3), wp.zeros(size, wp.vec2)
        averaged = shadow_cells(cells, stride, notes=False)
        averaged.filtered, averaged.surface = wp.array(values, dtype=wp.vec3), wp.zeros(cells, wp.int32)
        environment_shadow_filter.spread_ratio(ON_DESK, params, rays, RayScene(), None, averaged, out)
        expected = [np.clip(np.arange(n), axis[0], axis[-1]) for n, axis in zip(size, axes, strict=True)]
        np.testing.assert_allclose(out.numpy()[..., :2], np.stack(np.meshgrid(*expected, indexing="ij"), -1), atol=1e-5)


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
    averaged = shadow_cells(middle.shape, stride, notes=False)
    averaged.surface = wp.array(np.where(middle, 8, 0), dtype=wp.int32)
    averaged.filtered = wp.array(np.where(middle, 0.25, 1.0)[..., None].repeat(3, -1), dtype=wp.vec3)
    out, rays = wp.zeros((H, W), wp.vec3), wp.array(RAYS, dtype=wp.vec2)
    environment_shadow_filter.spread_ratio(ON_DESK, params, rays, scene, None, averaged, out)
    np.testing.assert_array_equal(out.numpy()[..., 0], np.where(on_board, 0.25, 1.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 100}, "count is 100"),
        ({"secondary": 0.0}, "secondary is 0"),
        ({"secondary": 1.5}, "secondary is 1.5"),
        ({"partials": 3}, "partials is 3"),
    ],
)
def test_bad_configs_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ON_DESK, **changes)


@pytest.mark.parametrize("stride", [1, 4, 5, 9])
def test_pixels_between_surfaces_may_have_a_kernel_of_their_own(device, monkeypatch, stride):
    """Cells of random surfaces, each on what is there or not: every pixel is written once, the same by both ways."""
    rng = np.random.default_rng(stride)
    shape_of_cells = -(-H // stride), -(-W // stride)
    board = shape(PLANE, (0.003, 0.004, 0.1), (0.083, 0.061, 0))
    scene = RayScene()
    scene.proxies = records(Shape, DESK, board)
    averaged = shadow_cells(shape_of_cells, stride, notes=False)
    averaged.surface = wp.array(rng.choice([-1, 0, 8], shape_of_cells, p=[0.2, 0.5, 0.3]), dtype=wp.int32)
    averaged.filtered = wp.array(rng.uniform(0.1, 0.9, (*shape_of_cells, 3)), dtype=wp.vec3)
    rays = wp.array(RAYS, dtype=wp.vec2)
    for rect in ((0, H, 0, W), (3, H - 2, 5, W - 1), (0, 0, 0, 0)):
        params = records(FrameParams, {"camera_position": CAMERA, "world_from_camera": LOOK_DOWN, "shadow_rect": rect})
        found = []
        for apart in (False, True):
            out = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3)
            monkeypatch.setattr(environment_shadow_filter, "spreads_apart", lambda *_, apart=apart: apart)
            environment_shadow_filter.spread_ratio(ON_DESK, params, rays, scene, None, averaged, out)
            found.append(out.numpy())
        if str(device) == "cpu":
            np.testing.assert_array_equal(found[1], found[0])
        else:  # NVRTC joins products and sums in each kernel as it likes
            np.testing.assert_allclose(found[1], found[0], rtol=1e-6)
        assert (found[1] < 2.0).all()
