"""Row 6: suns over dark skies, outliers, black maps, NaN, Inf, negative and denormal pixels; what garbage may reach.

Bounds: a finite answer everywhere, no light below zero, and no pixel or texel changed that the bad one cannot reach.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.hard_cases import atlas, generators
from tests.hard_cases.rig import (
    ENVIRONMENT_HEIGHT,
    EXACT,
    METHODS,
    SIZE,
    STAGE_METHODS,
    assert_finite,
    cases,
    numbers,
)
from warp_ar.kernels.environment.unwrap import RIM_START

MAP = (ENVIRONMENT_HEIGHT, 2 * ENVIRONMENT_HEIGHT)
FRAMES = generators.frames(SIZE[1], SIZE[0])
FINITE = generators.finite_maps(*MAP)
BROKEN = generators.broken_maps(*MAP)
# Light that a stage may read as a whole map.
MAPS = ("probe_radiance", "environment_radiance", "filled_radiance", "environment")
# What is documented to take any number; everything behind ``fill`` reads a map that is finite and not negative.
GUARDED = ("accumulate", "fill", "irradiance", "prefilter", "environment_samples")
# Signed by nature; of structures, only what is named radiance or irradiance is light.
SIGNED = ("irradiance_sh", "mirror_ball", "layer_mirror_ball", "normals", "position", "motion", "coverage")
FRAME_READERS = ("unwrap", "sphere_map", "summed_area", "visibility", "surfaces", "coverage", "motion")
MAP_READERS = [
    (stage, method) for stage, method in STAGE_METHODS if stage not in FRAME_READERS and method != "sphere_mip"
]


def assert_light(outputs, cause):
    assert_finite(outputs, cause)
    for name, values in outputs.items():
        for part, found in numbers(values):
            if found.dtype.kind == "f" and name not in SIGNED and (not part or "radiance" in part):
                assert (found >= 0).all(), f"{name}{part} is below zero {cause}"


@pytest.mark.slow
@pytest.mark.atlas(row=6)
@pytest.mark.parametrize(("stage", "method"), MAP_READERS)
def test_any_map_gives_finite_light(rig_for, stage, method):
    """Maps that an environment can have, into every stage that reads one; what no environment can have, into those
    that guard."""
    rig = rig_for(stage, method)
    reads = [name for name in MAPS if name in rig.stage(stage)[0].wiring.reads]
    # A stage that reads no map itself gets what the stages before it make of one.
    upstream = [] if reads else [name for name in METHODS if name in before(rig, stage)]
    maps = FINITE if not reads or stage not in GUARDED else {**FINITE, **BROKEN}
    for name, values in maps.items():
        for target in reads or ["environment"]:
            if target in rig.arrays:
                rig.poke(target, values)
            if f"{target}_confidence" in rig.arrays:
                rig.poke(f"{target}_confidence", 1.0)
        for earlier in upstream:
            rig.run(earlier)
        assert_light(rig.run(stage), f"for the map {name!r}")


def before(rig, stage):
    """Names of the stages between the environment and ``stage``."""
    names = [one.name for one, _ in rig.pipeline._scheduler._stages]
    start = names.index("fill") + 1
    return names[start : names.index(stage)] if stage in names[start:] else []


@pytest.mark.parametrize("combination", atlas.combinations(6))
def test_any_frame_gives_finite_light(rig_for, combination):
    """Frames as corrupt as 8 bits can be, through the whole pipeline."""
    rig = rig_for(combination)
    for name, image in FRAMES.items():
        rig.frame(image)
        outputs = {key: rig.get(key) for one, _ in rig.pipeline._scheduler._stages for key in one.wiring.writes}
        assert_light(outputs, f"for the frame {name!r}")


@pytest.mark.atlas(row=6, stage="pipeline")
@pytest.mark.parametrize("name", [*FINITE, *BROKEN])
def test_garbage_in_the_accumulated_light_is_a_picture_still(rig_for, name):
    """Whatever stands in the accumulated map, the complete one is light, and everything behind it finite."""
    rig = rig_for("shade", METHODS["shade"][-1])
    rig.poke("environment_radiance", {**FINITE, **BROKEN}[name])
    rig.poke("environment_confidence", 1.0)
    names = [one.name for one, _ in rig.pipeline._scheduler._stages]
    for stage in names[names.index("accumulate") + 1 :]:
        assert_light(rig.run(stage), f"in {stage}")


# --- Containment ------------------------------------------------------------------------------------------------------


def changed(rig, name, before_values, output):
    return (rig.run(name)[output] != before_values[output]).reshape(*before_values[output].shape[:2], -1).any(-1)


@pytest.mark.atlas(row=6, stage="unwrap")
@pytest.mark.parametrize("method", EXACT)
def test_a_pixel_reaches_only_the_texels_that_look_at_it(rig_for, method):
    rig = rig_for("unwrap", method)
    rig.poke("frame", FRAMES["grey"])
    clean = rig.run("unwrap")
    corners = rig.get("unwrap_corners")[:, :, 0]
    seen = corners[corners[..., 2] > RIM_START]
    reached = 0
    for x, y in np.unique(np.round(seen[:, :2]).astype(int), axis=0)[::2]:
        bad = FRAMES["grey"].copy()
        bad[y, x] = (255, 0, 7)
        rig.poke("frame", bad)
        touched = changed(rig, "unwrap", clean, "probe_radiance")
        # A bilinear sample inside the texel's quad reads the pixels within one of it.
        quads = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]])[..., :2]
        near = ((quads.min(0) < (x + 1, y + 1)) & (quads.max(0) > (x - 1, y - 1))).all(-1)
        assert not (touched & ~near).any(), f"pixel {x}, {y} changes texels that cannot see it"
        reached += touched.any()
    assert reached > 0, "the bad pixels must be seen at all"


@pytest.mark.atlas(row=6, stage="accumulate")
@pytest.mark.atlas(row=7, stage="accumulate")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -3281.0, -1e-3])
@pytest.mark.parametrize("where", ["probe_radiance", "probe_confidence", "probe_clipped"])
def test_what_is_no_light_is_gone_with_its_frame(rig_for, bad, where):
    """One bad texel in one frame: that texel waits, the others and all later frames are as if it had never been."""
    rig = rig_for("accumulate", "default")
    rig.poke("environment_confidence", 0.0)
    for name, value in (("probe_radiance", 0.5), ("probe_confidence", 1.0), ("probe_clipped", 0.25)):
        rig.poke(name, value)
    rig.run("accumulate")
    state = rig.state()
    clean, later = rig.run("accumulate"), rig.run("accumulate")
    rig.restore(state)
    values = rig.get(where)
    values[3, 4] = bad
    rig.poke(where, values)
    during = rig.run("accumulate")
    assert_finite(during)
    other = np.ones(MAP, bool)
    other[3, 4] = False
    for name, expected in clean.items():
        np.testing.assert_array_equal(during[name][other], expected[other])
    values[3, 4] = state[where][3, 4]
    rig.poke(where, values)
    after = rig.run("accumulate")
    # Values and shares are what they were; the confidence of a texel that was not seen recovers at its own pace.
    for name in ("environment_radiance", "environment_clipped"):
        np.testing.assert_array_equal(after[name], later[name])


@pytest.mark.atlas(row=6, stage="fill")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_broken_texel_is_completed_from_its_neighbours(rig_for, bad):
    """Filled like a hole: within the neighbours' range, and texels that are trusted stay as they are to the bit."""
    rig = rig_for("fill", "default")
    surroundings = np.random.default_rng(5).uniform(0.2, 0.8, (*MAP, 3)).astype(np.float32)
    rig.poke("environment_radiance", surroundings)
    rig.poke("environment_confidence", 1.0)
    (clean,) = rig.run("fill").values()
    surroundings[5, 6] = bad
    rig.poke("environment_radiance", surroundings)
    (filled,) = rig.run("fill").values()
    other = np.ones(MAP, bool)
    other[5, 6] = False
    np.testing.assert_array_equal(filled[other], clean[other])
    assert 0.2 <= filled[5, 6].min() <= filled[5, 6].max() <= 0.8


@pytest.mark.atlas(row=6)
@pytest.mark.parametrize(("stage", "method"), cases("irradiance", "prefilter", without="sphere_mip"))
def test_a_broken_texel_counts_as_no_light(rig_for, stage, method):
    """NaN and negative texels act as black ones, to the bit: no neighbour is poisoned."""
    rig = rig_for(stage, method)
    surroundings = np.random.default_rng(6).uniform(0.2, 0.8, (*MAP, 3)).astype(np.float32)
    surroundings[4, 5] = 0.0
    rig.poke("environment", surroundings)
    clean = rig.run(stage)
    for bad in (np.nan, -np.inf, -3281.0):
        surroundings[4, 5] = bad
        rig.poke("environment", surroundings)
        for name, values in rig.run(stage).items():
            np.testing.assert_array_equal(values, clean[name])


@pytest.mark.atlas(row=6)
@pytest.mark.parametrize(("stage", "method"), cases("composite", "expose"))
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 3e38])
def test_a_broken_layer_pixel_stays_one_pixel(rig_for, stage, method, bad):
    rig = rig_for(stage, method)
    clean = rig.run(stage)["image"]
    added = rig.get("added_light")
    row, column = np.argwhere(added.sum(-1) > 0)[10]
    added[row, column] = bad
    rig.poke("added_light", added)
    touched = (rig.run(stage)["image"] != clean).any(-1)
    touched[row, column] = False
    assert not touched.any()


# --- Any magnitude ----------------------------------------------------------------------------------------------------
