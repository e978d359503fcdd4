"""The picture's layers: together they are the picture, and apart they are what their names say."""

import dataclasses

import numpy as np
import pytest

from tests.error_model import check_error
from tests.layer_rig import POSES, SIZE, make_frame, make_scene, run
from tests.twins import color as reference_color
from tests.twins import expose as reference_expose
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.kernels import color
from warp_ar.output.layer_file import compose_layers
from warp_ar.scene import Exposure
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import LAYERS, PICTURE_LAYERS
from warp_ar.tracking.tracking import Track, TrackState

pytestmark = pytest.mark.slow

# Rounding to codes, and what float32 adds to it: a thousandth of a code.
CODES = 0.501


def recombined(result):
    """The picture by the documented formula, in codes that are not rounded."""
    linear = result.exposure_scale * compose_layers(result.layers).astype(np.float64)
    return reference_color.encoded_srgb(np.clip(linear, 0.0, 1.0))


@pytest.mark.parametrize(
    ("scale", "quality"), [(0.7, "paper"), (0.7, "low"), (1.0, "medium"), (1.5, "medium"), ("auto", "medium")]
)
def test_layers_together_are_the_picture(device, quality, scale):
    scene = make_scene(exposure=Exposure(scale))
    with Pipeline(scene, device=device, quality=quality, outputs=("image", *PICTURE_LAYERS)) as pipeline:
        for result in run(pipeline):
            assert np.abs(recombined(result) - result.image).max() <= CODES
            if scale != "auto":
                assert result.exposure_scale == pytest.approx(scale)
    changed = {name: (result.layers[name] != LAYERS[name].neutral).any() for name in PICTURE_LAYERS[1:]}
    assert changed["objects"]
    assert changed["added_light"]


def test_layers_change_nothing_of_the_picture(device):
    scene = make_scene(exposure=Exposure(0.7))
    with (
        Pipeline(scene, device=device, quality="medium", estimates="synchronous") as plain,
        Pipeline(
            scene, device=device, quality="medium", estimates="synchronous", outputs=("image", *LAYERS)
        ) as layered,
    ):
        for one, other in zip(run(plain), run(layered), strict=True):
            np.testing.assert_array_equal(one.image, other.image)


def test_plate_matches_twin(device):
    """Linear radiance of the frame, clipped pixels as the exposure guesses them."""
    quality = PRESETS["low"].with_methods(expose="paper")
    scene = make_scene(exposure=Exposure(0.5))
    frame = make_frame()
    with Pipeline(scene, device=device, quality=quality, outputs=("plate",)) as pipeline:
        plate = pipeline(frame, pose=POSES[0]).layers["plate"]
    decoded = reference_color.decode(color.decode_table("srgb"), frame)
    gains = reference_expose.gains(frame, 0.5, max(1, round(SIZE[1] / 8)))
    assert gains.max() > 1.0
    check_error("separate", plate, decoded * gains[..., None])


def test_a_layer_that_the_scene_lacks_is_neutral(device):
    scene = make_scene(objects=(), lights=())
    with Pipeline(scene, device=device, quality="medium", outputs=tuple(LAYERS)) as pipeline:
        layers = pipeline(make_frame(), pose=POSES[0]).layers
    for name in PICTURE_LAYERS[1:]:
        assert (layers[name] == LAYERS[name].neutral).all(), name
    assert layers["ids"].max() == 2


def test_what_left_the_picture_leaves_its_layers(device):
    """An object goes out of view: nothing of it stays in a layer."""
    away = dataclasses.replace(POSES[0], translation=POSES[0].translation + np.array([5.0, 0.0, 0.0]))
    with Pipeline(make_scene(), device=device, quality="medium", outputs=("image", *LAYERS)) as pipeline:
        run(pipeline)
        result = pipeline(make_frame(), pose=away)
        for name in ("objects", "mirror_ball"):
            assert not result.layers[name].any(), name
        assert (result.layers["ids"] == -1).all()
        np.testing.assert_array_equal(result.image, make_frame())


class Lost:
    """A tracker that finds nothing."""

    def track(self, image, time):
        return Track(None, TrackState.LOST, 1.0, None, 0.0)


def test_a_lost_frame_has_neutral_layers(device):
    frame = make_frame()
    with Pipeline(make_scene(), device=device, quality="low", outputs=("image", *LAYERS)) as pipeline:
        shapes = {name: (values.shape, values.dtype) for name, values in run(pipeline)[0].layers.items()}
        pipeline._tracker = Lost()
        result = pipeline(frame)
        assert result.pose is None
        for name, layer in LAYERS.items():
            values = result.layers[name]
            assert (values.shape, values.dtype) == shapes[name]
            if name == "plate":
                np.testing.assert_allclose(recombined(result), frame, atol=CODES)
            elif name == "coverage":
                assert (values[..., 0::2] == -1).all()
                assert not values[..., 1::2].any()
            else:
                assert (values == layer.neutral).all(), name


def test_an_unknown_layer_is_named():
    with pytest.raises(UsageError, match=r"outputs: 'dept' is unknown; did you mean 'depth'\? expected any of image"):
        Pipeline(make_scene(), device="cpu", outputs=("dept",))
