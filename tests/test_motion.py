"""Motion of surfaces in the picture, against projections in float64."""

import numpy as np

from tests.error_model import check_error
from tests.layer_rig import POSES, SIZE, TIMES, make_frame, make_scene, run
from tests.twins import surfaces as reference
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene.geometry import rotation_matrix


def test_matches_twin(device):
    """A camera that moves, then one that stands, and an object that moves before both."""
    scene = make_scene()
    with Pipeline(scene, device=device, quality="low", outputs=("motion", "ids")) as pipeline:
        results = run(pipeline)
    assert not results[0].layers["motion"].any(), "before the first frame there is none"
    for k in (1, 2):
        rays = reference.directions(scene.camera, POSES[k])
        index, _, _, place = reference.find(scene, rotation_matrix, POSES[k], TIMES[k], rays)
        expected = reference.motion(scene, index, place, POSES[k], TIMES[k], POSES[k - 1], TIMES[k - 1])
        found = results[k].layers["motion"].reshape(-1, 2)
        assert np.abs(expected).max() > 1.0, "pixels"
        check_error("motion", found, expected)
    still = (results[2].layers["ids"] != 1) & (results[1].layers["ids"] != 1)
    assert still.any()
    assert not results[2].layers["motion"][still].any(), "to the bit"


def test_it_leads_back_to_the_same_surface(device):
    """``before[pixel - motion]`` shows the same number, but for outlines and for what was hidden."""
    with Pipeline(make_scene(), device=device, quality="low", outputs=("motion", "ids")) as pipeline:
        before, after, _ = run(pipeline)
    ids, motion = after.layers["ids"], after.layers["motion"]
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    at = np.rint(np.stack([columns, rows], -1) - motion).astype(int)
    inside = ((at >= 0) & (at < SIZE)).all(-1) & (ids >= 0)
    same = before.layers["ids"][at[inside][:, 1], at[inside][:, 0]] == ids[inside]
    # Of 64x48 pixels every tenth lies at an outline.
    assert same.mean() > 0.9


def test_frames_that_repeat_do_not_move(device):
    scene = make_scene(objects=())
    with Pipeline(scene, device=device, quality="low", outputs=("motion",)) as pipeline:
        for _ in range(2):
            still = pipeline(make_frame(), pose=POSES[0]).layers["motion"]
            assert not still.any()
        moved = pipeline(make_frame(), pose=POSES[1]).layers["motion"]
        assert moved.any()
        again = pipeline(make_frame(), pose=POSES[1]).layers["motion"]
        assert not again.any(), "the frame before is the last one, not the one before that"
