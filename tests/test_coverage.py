"""Shares of pixels, against counted rays in float64."""

import dataclasses

import numpy as np
import pytest

from tests.error_model import check_error
from tests.layer_rig import POSES, make_frame, make_scene
from tests.twins import coverage as reference
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.receiver.surfaces import RANKS
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.stages.quality import PRESETS

# Of some hundred edge pixels' samples one or two may fall to the other side of an outline by rounding.
OUTLINE_PIXELS = 3


def by_surface(coverage, count):
    found = np.zeros((*coverage.shape[:2], count + 1))
    for rank in range(RANKS):
        index = coverage[..., 2 * rank].astype(int)
        np.put_along_axis(
            found,
            index[..., None],
            np.take_along_axis(found, index[..., None], -1) + coverage[..., 2 * rank + 1, None],
            -1,
        )
    return found[..., :count]


@pytest.mark.parametrize("samples", [1, 4, 16])
def test_matches_twin(device, samples):
    scene = make_scene()
    quality = dataclasses.replace(PRESETS["low"], edge_samples=samples)
    with Pipeline(scene, device=device, quality=quality, outputs=("coverage", "ids")) as pipeline:
        layers = pipeline(make_frame(), pose=POSES[0]).layers
    expected = reference.shares(scene, rotation_matrix, POSES[0], 0.0, layers["ids"], samples)
    if samples == 1:
        expected = np.stack([layers["ids"] == k for k in range(expected.shape[-1])], -1).astype(float)
    found = by_surface(layers["coverage"], expected.shape[-1])
    off = (found != expected).any(-1)
    assert off.sum() <= OUTLINE_PIXELS
    check_error("coverage", found[~off], expected[~off])
    if samples > 1:
        assert ((found > 0.0) & (found < 1.0)).any()


def test_ranks_fall_and_none_is_twice(device):
    with Pipeline(make_scene(), device=device, quality="medium", outputs=("coverage",)) as pipeline:
        coverage = pipeline(make_frame(), pose=POSES[0]).layers["coverage"]
    which, share = coverage[..., 0::2], coverage[..., 1::2]
    assert (np.diff(share, axis=-1) <= 0.0).all()
    assert share.sum(-1).max() <= 1.0
    assert ((which < 0) == (share == 0.0)).all()
    for a in range(RANKS):
        for b in range(a):
            assert not ((which[..., a] == which[..., b]) & (which[..., a] >= 0)).any()


def test_objects_cover_what_the_picture_says(device):
    """The coverage of all objects is the alpha of the layer ``objects`` where that is sampled, too."""
    with Pipeline(make_scene(), device=device, quality="medium", outputs=("coverage", "objects")) as pipeline:
        layers = pipeline(make_frame(), pose=POSES[0]).layers
    covered = by_surface(layers["coverage"], 6)[..., :3].sum(-1)
    alpha = layers["objects"][..., 3]
    # ``shade`` looks at four neighbours, ``coverage`` at eight: a pixel that only a corner touches may differ.
    assert (np.abs(covered - alpha) > 1e-6).mean() < 0.01
    assert np.abs(covered - alpha).max() <= 0.5
