"""Several mirror balls: objects between them are lit by what is interpolated, against a desk whose light is known."""

from __future__ import annotations

import numpy as np
import pytest

from tests.rendered_lamp import Array, Desk
from tests.twins import latlong
from tests.two_balls import ALBEDO, BALLS, PLACES, TwoBalls, hits, make_scene, material, pose, rms, shares, shown_of
from warp_ar.engine.pipeline import Pipeline
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

DESK = Desk()
WORLD = TwoBalls(DESK)
QUALITY = PRESETS["low"].with_methods(recover="clipped")
# Float32 through a hit (a normal is a difference of metres over 15 mm, 1e-5), a map and a sum of a few terms.
SHADING = 1e-4
# The same normals turn what a mirror shows by twice as much, across a lamp's edge that is one texel of 0.05 wide.
MIRRORING = 1e-3


def by_maps(
    pipeline: Pipeline,
    index: int,
    mirror: bool = False,
    trusts: tuple[float, ...] = (1.0, 1.0),
    right: float = 0.0,
) -> Array:
    """Radiance of an object's pixels, (n, 3), by the maps that a pipeline has of its balls."""
    _, points, normals, toward = hits(index, right)
    arrays, name = pipeline.arrays, "environment" if mirror else "irradiance"
    first = arrays[name if mirror else "irradiance_map"].numpy()
    maps = [one.astype(np.float64) for one in (first, *arrays[f"others_{name}"].numpy())]
    light = [
        latlong.sample_latlong(one, toward) if mirror else ALBEDO / np.pi * latlong.sample_latlong(one, normals)
        for one in maps
    ]
    return np.asarray(np.einsum("nb,bnc->nc", shares(BALLS, points, trusts), light))


@pytest.mark.parametrize("mirror", [False, True])
def test_objects_have_the_light_of_the_balls_maps_by_their_weights(device: str, mirror: bool) -> None:
    with Pipeline(make_scene(BALLS, material(mirror)), device=device, quality=QUALITY) as pipeline:
        pipeline(WORLD.photograph(), pose=pose(), time_seconds=0.0)
        for index in range(len(PLACES)):
            found, whole = shown_of(pipeline, index)
            expected = by_maps(pipeline, index, mirror)
            np.testing.assert_allclose(found[whole], expected[whole], rtol=MIRRORING if mirror else SHADING)


@pytest.mark.parametrize("mirror", [False, True])
def test_interpolated_light_is_nearer_to_the_truth_than_either_balls(device: str, mirror: bool) -> None:
    """On objects between the balls, whose error is what interpolation cannot do: it is compared, not bounded.

    A mirror shows the lamp at each ball's place, as brightly as the ball has weight: right in the mean, not where.
    """
    errors, true = np.zeros((3, len(PLACES))), [WORLD.truth(index, mirror) for index in range(len(PLACES))]
    for case, probes in enumerate((BALLS[:1], BALLS[1:], BALLS)):
        with Pipeline(make_scene(probes, material(mirror)), device=device, quality=QUALITY) as pipeline:
            pipeline(WORLD.photograph(), pose=pose(), time_seconds=0.0)
            shown = [shown_of(pipeline, index) for index in range(len(PLACES))]
        for index, (light, whole) in enumerate(shown):
            found, expected = light[whole], true[index][whole]
            if mirror:
                found, expected = found.mean(0), expected.mean(0)
            errors[case, index] = rms(found - expected) / rms(expected)
    print(np.round(errors, 3))
    between = errors[:, 1:4]
    assert between[2].mean() < between[:2].mean(1).min()
    if not mirror:  # which, on its way from ball to ball, is now nearer to one's light, now to the other's
        np.testing.assert_array_less(between[2], between[:2].min(0))
