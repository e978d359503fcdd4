"""Row 7: what is kept from frame to frame neither drifts nor decays, and forgets a bad frame.

Of the whole pipeline these are a few hundred small frames, with ``--long`` ten thousand.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.hard_cases import generators, long_run
from tests.hard_cases.rig import SIZE, Rig, methods, solid_angles
from warp_ar.scene import Exposure

FRAMES = generators.frames(SIZE[1], SIZE[0])
# Energy of the map: what is left of a frame after two seconds, and of a search that began elsewhere.
REMEMBERED = 0.05


@pytest.mark.slow
@pytest.mark.atlas(row=7, stage="pipeline")
@pytest.mark.atlas(row=15, stage="pipeline")
@pytest.mark.parametrize("case", long_run.CASES)
def test_long_runs(device, case, request):
    """No drift, no growth, and outputs after a loop equal to those after one."""
    long = request.config.getoption("--long")
    if case == long_run.SEARCHES and not long:
        pytest.skip("settles after ten seconds: --long")
    report = long_run.run(case, frames=10_000 if long else 240, device=device)
    assert report.drift <= long_run.DRIFT, report
    assert report.finite, report
    if long:  # a short run has not warmed up
        assert report.growth <= long_run.GROWTH, report


@pytest.mark.atlas(row=7, stage="expose")
@pytest.mark.parametrize("method", methods("expose"))
def test_an_automatic_exposure_that_was_spoilt_heals(device, method):
    """Whatever stands in the scale, seconds of good frames bring it back to where it belongs."""
    with Rig(device, "expose", method, exposure=Exposure("auto")) as rig:
        for _ in range(5):
            rig.frame(FRAMES["ramp"])
        expected = rig.get("expose_scale")
        for bad in (np.nan, np.inf, -1.0, 0.0):
            rig.poke("expose_scale", bad)
            for _ in range(25):  # 2.5 seconds, time constant 0.3: 0.02 % of what was off is left
                image = rig.frame(FRAMES["ramp"])
                rig.count += 2  # ten frames a second
            np.testing.assert_allclose(rig.get("expose_scale"), expected, rtol=1e-3, err_msg=f"after {bad}")
            assert image.any()


@pytest.mark.atlas(row=7, stage="recover")
@pytest.mark.parametrize("method", methods("recover"))
@pytest.mark.parametrize("bad", ["white", "noise"])
def test_recovered_light_forgets_a_corrupt_frame(device, method, bad):
    """What is remembered on the host, too: two seconds later the map is what it is where that frame never was."""
    with Rig(device, "recover", method) as rig, Rig(device, "recover", method) as clean:
        for index in range(30):
            for one in (rig, clean):
                one.frame(FRAMES[bad] if one is rig and index == 8 else FRAMES["top half saturated"])
                one.count += 2  # ten frames a second
        expected, found = clean.get("environment"), rig.get("environment")
    assert np.isfinite(found).all()
    assert expected.max() > 1.1, "something must have been recovered"
    energy = solid_angles(*expected.shape[:2])[..., None]
    np.testing.assert_allclose((energy * found).sum((0, 1)), (energy * expected).sum((0, 1)), rtol=REMEMBERED)


@pytest.mark.atlas(row=7, stage="accumulate")
@pytest.mark.parametrize("bad", ["white", "black", "noise"])
def test_one_corrupt_frame_is_forgotten(device, bad):
    """A frame of garbage in a still sequence: after a second the light is within a code of what it was.

    The light as captured: what recovery makes of it, and remembers, is not counted in codes, and has a test of its own.
    """
    with Rig(device) as rig:
        for name in ("ramp",) * 14:
            rig.frame(FRAMES[name])
            rig.count += 2  # ten frames a second
        before = rig.get("filled_radiance")
        for name in (bad, *("ramp",) * 10):
            rig.frame(FRAMES[name])
            rig.count += 2
        np.testing.assert_allclose(rig.get("filled_radiance"), before, atol=1.5 / 255)
