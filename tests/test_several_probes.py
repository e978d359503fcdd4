"""Several mirror balls: objects between them are lit by what is interpolated, against a desk whose light is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import latlong
from tests.rendered_lamp import Array, Desk
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
TRUST_TIME = 0.4


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


def test_a_ball_that_leaves_the_picture_goes_out_smoothly(device: str) -> None:
    """In the frame in which it leaves nothing changes but by its trust; later objects have the other one's light."""
    away = -0.5  # the second ball is out of the picture, the first one and the object beside it are in it
    frames = [(WORLD.photograph(), pose())] * 2 + [(WORLD.photograph(away), pose(away))] * 40
    with Pipeline(make_scene(BALLS, material(False)), device=device, quality=QUALITY) as pipeline:
        for number, (frame, at) in enumerate(frames):
            pipeline(frame, pose=at, time_seconds=0.1 * number)
            trust = math.exp(-0.1 * max(number - 1, 0) / TRUST_TIME)
            places = pipeline.arrays["probe_places"].numpy()
            # One rounding of float32 a frame.
            np.testing.assert_allclose(places[:, 3], [1.0, trust], rtol=6e-8 * (number + 4))
            if number % 8 == 2:
                found, whole = shown_of(pipeline, 1, away)
                expected = by_maps(pipeline, 1, False, (1.0, trust), away)
                np.testing.assert_allclose(found[whole], expected[whole], rtol=SHADING)
    assert trust < 1e-4


def test_the_environments_are_those_of_the_balls(device: str) -> None:
    """As an output: the first one's is ``environment``, each further ball has its own, whatever their order.

    What a ball tells is that ball's, but for a vote of each pixel of the others that counts ``BORROWED``: 0.001, of a
    radiance that is off by the lamp's at most, and of no more than four times the pixels a steradian.
    """
    borrowed = 4.0 * 0.001 * DESK.lamp
    found = {}
    for name, balls in (("both", BALLS), ("swapped", BALLS[::-1]), ("first", BALLS[:1]), ("second", BALLS[1:])):
        scene = make_scene(balls, material(False))
        with Pipeline(scene, device=device, quality=QUALITY, outputs=("image", "environment")) as pipeline:
            result = pipeline(WORLD.photograph(), pose=pose(), time_seconds=0.0)
            found[name] = result.environments
            np.testing.assert_array_equal(result.environment, result.environments[0])
            if len(balls) == 1:
                found[f"{name} told"] = pipeline.arrays["environment_confidence"].numpy()
    both, swapped = found["both"], found["swapped"]
    assert [len(found[name]) for name in ("both", "swapped", "first", "second")] == [2, 2, 1, 1]
    for number, name in enumerate(("first", "second")):
        told = found[f"{name} told"] > 0.8
        assert told.mean() > 0.4
        np.testing.assert_allclose(both[number][told], found[name][0][told], atol=borrowed)
        np.testing.assert_allclose(swapped[1 - number][told], found[name][0][told], atol=borrowed)
    # Where one sees the lamp the other sees the room.
    assert np.abs(both[0] - both[1]).max() > 0.98 * (DESK.lamp - max(DESK.room))
