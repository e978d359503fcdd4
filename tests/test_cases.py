"""Cases with their truth."""

from __future__ import annotations

import numpy as np
import pytest

from warp_ar.accuracy import cases
from warp_ar.kernels.color import decode_table


def test_bundled_scenes_end_with_their_truth():
    case = cases.open_scene("desk", 2, 4)
    assert len(case.frames) == 2
    assert list(case.truth) == [1]
    region = case.regions[1]
    camera, truth = case.frames[1].image, case.truth[1]
    assert 0.05 < region.mean() < 0.5
    # Nothing virtual, nothing changed.
    np.testing.assert_array_equal(truth[~region], camera[~region])
    assert np.abs(truth[region].astype(int) - camera[region]).mean() > 5.0


def test_where_nothing_clips_the_truth_of_a_shorter_exposure_is_known():
    case = cases.open_scene("darken", 1, 1)
    camera, truth, region = case.frames[0].image, case.truth[0], case.regions[0]
    decode = decode_table("srgb")[:, 0]
    scaled = 0.5 * decode[camera[~region]]
    # Rounding to a code: half of the step between codes there.
    assert np.abs(decode[truth[~region]] - scaled).max() <= 0.51 * np.diff(decode).max()
    assert region[(camera >= 255).any(-1)].mean() > 0.95


@pytest.mark.parametrize("scale", [0.0, 0.3, 1.0])
def test_scaling_codes_is_scaling_radiance(scale):
    image = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, -1)
    scaled = cases.scale_codes(image, scale, "linear")
    np.testing.assert_array_equal(scaled[0, :, 0], np.floor(np.arange(256) * scale + 0.5))
