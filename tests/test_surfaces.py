"""Depth, normals, places and numbers of surfaces, against rays in float64."""

import numpy as np
import pytest

from tests.error_model import check_error
from tests.layer_rig import POSES, SIZE, TIMES, look_at, make_frame, make_scene, run
from tests.twins import surfaces as reference
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene.geometry import rotation_matrix

OUTPUTS = ("ids", "depth", "normals", "position")
# Pixels whose centre lies within rounding of an outline may show either side; in these pictures none does.
OUTLINE_PIXELS = 0


def test_matches_twin(device):
    scene = make_scene()
    with Pipeline(scene, device=device, quality="low", outputs=OUTPUTS) as pipeline:
        results = run(pipeline)
    for result, pose, seconds in zip(results, POSES, TIMES, strict=True):
        rays = reference.directions(scene.camera, pose)
        index, depth, normal, place = reference.find(scene, rotation_matrix, pose, seconds, rays)
        found = {name: values.reshape(SIZE[0] * SIZE[1], -1) for name, values in result.layers.items()}
        assert set(np.unique(index)) == {-1, 0, 1, 2, 3, 4, 5}, "every surface is in the picture, and nothing is too"
        assert (found["ids"][:, 0] != index).sum() <= OUTLINE_PIXELS
        known = index >= 0
        check_error("surfaces", found["depth"][known, 0], depth[known])
        check_error("surfaces", found["normals"], normal)
        check_error("surfaces", found["position"], place)
        assert np.isinf(found["depth"][~known]).all()


def test_what_hides_what(device):
    """A proxy hides what is behind it from either side, and shows its front alone."""
    scene = make_scene()
    below = look_at((0.05, -0.35, -0.3))
    with Pipeline(scene, device=device, quality="low", outputs=("ids", "depth")) as pipeline:
        ids = pipeline(make_frame(), pose=below).layers["ids"]
    # Seen from below the plane: it hides what stands on it, and is not seen itself. The box touches it, and shows.
    assert set(np.unique(ids)) == {-1, 1, 4}


@pytest.mark.parametrize("part", ["objects", "proxies", "probes"])
def test_a_scene_without_some_of_it(device, part):
    scene = make_scene(**{part: ()})
    with Pipeline(scene, device=device, quality="low", outputs=OUTPUTS) as pipeline:
        ids = pipeline(make_frame(), pose=POSES[0]).layers["ids"]
    rays = reference.directions(scene.camera, POSES[0])
    index = reference.find(scene, rotation_matrix, POSES[0], 0.0, rays)[0]
    np.testing.assert_array_equal(ids.ravel(), index)
