"""Rows 15 and 16: markers lost and found, frames that are none. More stands in test_tracking.py, test_sources.py."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hard_cases import generators
from tests.hard_cases.rig import SIZE, Rig
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Marker
from warp_ar.tracking.tracking import Tracker, TrackState

FRAMES = generators.frames(SIZE[1], SIZE[0])


@pytest.mark.atlas(row=15, stage="track")
@given(name=st.sampled_from(sorted(FRAMES)), rows=st.integers(1, 90), columns=st.integers(1, 90))
def test_no_picture_of_any_size_breaks_the_tracker(name, rows, columns):
    """From a single pixel up: lost, without an exception."""
    image = np.resize(FRAMES[name], (rows, columns, 3))
    tracker = Tracker(Marker(size=0.08), Camera(columns, rows, 50.0, 50.0, columns / 2, rows / 2))
    for frame in range(3):
        found = tracker.track(image, frame / 30)
        assert found.state is TrackState.LOST
        assert found.pose is None


@pytest.mark.atlas(row=15, stage="pipeline")
@pytest.mark.parametrize("pattern", ["10", "110", "100", "01"])
def test_lost_and_found_every_frame(device, pattern):
    """While lost the frame passes to the bit and the light stays; found again, it is lit again."""
    with Rig(device) as rig:
        pose = rig.tracker.pose
        light = None
        for frame in range(24):
            seen = pattern[frame % len(pattern)] == "1"
            rig.tracker.pose = pose if seen else None
            picture = rig.frame(FRAMES["ramp"])
            if seen:
                light = rig.get("environment")
                assert (picture != FRAMES["ramp"]).any()
            else:
                np.testing.assert_array_equal(picture, FRAMES["ramp"])
                if light is not None:
                    np.testing.assert_array_equal(rig.get("environment"), light)


@pytest.mark.atlas(row=16, stage="pipeline")
@given(
    shape=st.sampled_from(
        [
            (36, 48),
            (36, 48, 1),
            (36, 48, 4),
            (35, 48, 3),
            (36, 49, 3),
            (0, 48, 3),
            (36, 0, 3),
            (0,),
            (),
            (48, 36, 3),
            (1, 36, 48, 3),
        ]
    ),
    kind=st.sampled_from([np.uint8, np.uint16, np.float32, np.float64, np.int8, bool]),
)
def test_what_is_no_frame_is_refused_and_the_next_one_works(rig_for, shape, kind):
    """Grey, RGBA, 16 bit, float with NaN, empty and of another size: one error that says what would be right."""
    rig = rig_for("fill", "default")
    image = np.zeros(shape, kind)
    if image.dtype.kind == "f":
        image[...] = np.nan
    with pytest.raises(UsageError, match=r"expected uint8 RGB \(36, 48, 3\)"):
        rig.pipeline(image)
    assert rig.frame(FRAMES["ramp"]).shape == (36, 48, 3)
