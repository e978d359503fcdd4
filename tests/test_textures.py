"""Pictures on surfaces: the float64 twin, mip levels, samplers; nothing shimmers; masks stay as dense from afar."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import warp as wp

from tests.twins import textures as reference
from warp_ar.kernels.structs import RayScene, Texture
from warp_ar.kernels.textures import SurfacePoint, sample_texture
from warp_ar.scene.materials import IDENTITY, TextureUse
from warp_ar.scene.texture_pack import DECODE, TexturePack, encode_texture, mip_levels

# Coordinates of 3 are rounded to 2e-7, seven texels wide; weights are products of two such.
SAMPLE_TOLERANCE = 1e-5
# Log2 of the footprint is good to 1e-6, and neighbouring levels differ by less than 1.
LEVEL_TOLERANCE = 2e-5


@wp.kernel(enable_backward=False, module="unique")
def sample_kernel(
    # In:
    scene: RayScene,
    index: wp.int32,
    uvs: wp.array[wp.vec2],
    width: wp.float32,
    # Out:
    color_out: wp.array[wp.vec4],
):
    i = wp.tid()
    point = SurfacePoint()
    point.uv = uvs[i]
    point.uv_second = wp.vec2(uvs[i][1], uvs[i][0])
    point.width = width
    point.density = wp.vec2(1.0, 1.0)
    color_out[i] = sample_texture(scene, index, point)


def packed(pack: TexturePack, device) -> RayScene:
    scene = RayScene()
    records = np.zeros(len(pack.records), np.dtype(Texture.numpy_dtype()))
    for record, values in zip(records, pack.records, strict=True):
        for name, value in values.items():
            record[name] = value
    scene.textures = wp.array(records, dtype=Texture, device=device)
    scene.texels = wp.array(np.concatenate(pack.texels), dtype=wp.uint32, device=device)
    scene.decode_table = wp.array(DECODE, dtype=wp.float32, device=device)
    return scene


def sampled(scene, index, uvs, width, device):
    colors = wp.zeros(len(uvs), dtype=wp.vec4, device=device)
    inputs = [scene, index, wp.array(uvs.astype(np.float32), dtype=wp.vec2, device=device), float(width)]
    wp.launch(sample_kernel, dim=len(uvs), inputs=inputs, outputs=[colors], device=device)
    return colors.numpy()


def linear(level, *, encoded=True):
    """Linear float64 values of a picture."""
    table = DECODE[256 * encoded :][:256].astype(np.float64)
    return np.concatenate([table[level[..., :3]], level[..., 3:] / 255.0], axis=2)


def noise(height, width, seed=3):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 4)).astype(np.uint8)


CORNERS = [(0, 0), (1, 1), (1 - 1e-8, 1e-8), (-1e-9, 1 + 1e-9), (0.5 / 7, 1 - 0.5 / 5), (-3.25, 7.75)]
USES = {
    "repeat": TextureUse(1),
    "clamp": TextureUse(1, wrap=("clamp", "clamp")),
    "mirror": TextureUse(1, wrap=("mirror", "clamp")),
    "nearest": TextureUse(1, nearest=True),
    "moved": TextureUse(1, transform=(0.8, -0.6, 0.25, 0.6, 0.8, -0.5), wrap=("repeat", "mirror")),
    "second": TextureUse(1, uv_set=1),
}


@pytest.mark.parametrize("name", USES)
@pytest.mark.parametrize("texels", [0.0, 1.0, 2.7, 1e9])
def test_sampling_matches_reference(device, name, texels):
    """Noise of an odd size, across the border and far outside; a shift of half a texel would show."""
    use, images = USES[name], (noise(2, 2), noise(5, 7))
    pack = TexturePack()
    pack.add(TextureUse(0), images, encoded=True)
    index = pack.add(use, images, encoded=True)
    uvs = np.concatenate([CORNERS, np.random.default_rng(4).uniform(-2, 3, (2000, 2))]).astype(np.float32)
    found = sampled(packed(pack, device), index, uvs, texels / np.sqrt(35.0), device)
    at = uvs.astype(np.float64)[:, ::-1] if use.uv_set else uvs.astype(np.float64)
    levels = [linear(level) for level in mip_levels(images[1], encoded=True)]
    expected = reference.sample_texture(levels, at, use.transform, use.wrap, texels, nearest=use.nearest)
    keep = np.ones(len(uvs), bool)
    if use.nearest:  # a texel's border belongs to either
        x, y = at[:, 0] * 7, at[:, 1] * 5
        keep = (np.abs(x - np.round(x)) > 1e-4) & (np.abs(y - np.round(y)) > 1e-4)
    np.testing.assert_allclose(found[keep], expected[keep], atol=max(SAMPLE_TOLERANCE, LEVEL_TOLERANCE))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (6, 5), (64, 16)])
def test_levels_are_means_in_linear_light(size):
    picture = noise(*size)
    levels = mip_levels(picture, encoded=True)
    assert levels[-1].shape == (1, 1, 4)
    assert len(levels) == int(np.log2(max(size))) + 1
    mean = linear(picture).mean(axis=(0, 1))
    # Half a code at every level: sRGB's steps are below 0.009 in linear light.
    np.testing.assert_allclose(linear(levels[-1])[0, 0], mean, atol=0.005)
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(encode_texture(DECODE[256:], encoded=True), codes)


def test_masks_stay_as_dense_from_afar():
    """A tenth of the picture is there, in specks: their mean alpha soon is below the cutoff everywhere."""
    field = cv2.GaussianBlur(np.random.default_rng(0).random((128, 128)), (0, 0), 1.5)
    picture = np.full((128, 128, 4), 200, np.uint8)
    picture[..., 3] = 255 * np.clip(0.5 + 40.0 * (field - np.quantile(field, 0.9)), 0.0, 1.0)
    picture[picture[..., 3] == 0, :3] = 0
    levels = mip_levels(picture, encoded=True, cutoff=0.5)
    for level in levels[:5]:
        assert (level[..., 3] >= 127).mean() == pytest.approx(0.1, abs=0.03)
        there = level[..., 3] >= 127
        assert level[there][:, :3].min() >= 198  # what is cut away does not bleed in
    assert (mip_levels(picture, encoded=True)[4][..., 3] >= 127).mean() < 0.02


def test_nothing_shimmers(device):
    """Noise seen at six texels per pixel, moved by a third of a pixel per frame: a pixel hardly changes."""
    images = (noise(256, 256, seed=8),)
    pack = TexturePack()
    index = pack.add(TextureUse(0), images, encoded=True)
    scene = packed(pack, device)
    pixel = 6.0 / 256.0
    grid = np.stack(np.meshgrid(np.arange(24), np.arange(24)), axis=-1).reshape(-1, 2) * pixel

    def unrest(width):
        frames = [sampled(scene, index, grid + k * pixel / 3.0, width, device)[:, 0] for k in range(6)]
        return float(np.abs(np.diff(frames, axis=0)).mean())

    # A level's texel is as wide as a pixel: the mean of 36 texels, and of it what a third of a pixel changes.
    assert unrest(pixel) < 0.2 * unrest(0.0)


def test_a_picture_is_packed_once():
    images = (noise(4, 4),)
    pack = TexturePack()
    uses = [TextureUse(0), TextureUse(0, nearest=True), TextureUse(0)]
    assert [pack.add(use, images, encoded=True) for use in uses] == [0, 1, 0]
    assert [pack.add(uses[0], images, encoded=False), pack.add(None, images, encoded=True)] == [2, -1]
    assert [record["offset"] for record in pack.records] == [0, 0, 21]
    assert uses[0].transform == IDENTITY
