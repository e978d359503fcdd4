"""What was recovered in one ball's map, as another ball sees it."""

import numpy as np
import pytest
import warp as wp

from tests.reference import latlong
from warp_ar.kernels.relocate import move_emitters, relocate
from warp_ar.kernels.structs import Emitter

HEIGHT = 64
HERE = np.array([0.02, -0.01, 0.04])
"""Where the first ball mirrors the lamp to the camera."""
LAMP = HERE + 0.5 * np.array([0.48, 0.6, 0.64])
THERE = np.array([0.3, 0.1, 0.04])
# A lamp is turned as a whole: what varies of the turn is 2 s^4, s the lamp's width over 2.5 times the way, below 1e-3
# here. Sums over texels of a cone three texels wide are those of the midpoint rule, (h / width)^2 / 12 off, and so is
# its middle, by that share of its width.
WIDTH = 0.15
ENERGY = (np.pi / 64 / WIDTH) ** 2 / 12
# Float32 vectors of a metre.
ROUNDING = 1e-6


def emitter_records(*entries):
    records = np.zeros(4, np.dtype(Emitter.numpy_dtype()))
    for record, fields in zip(records, entries, strict=False):
        for name, value in fields.items():
            record[name] = value
    return wp.array(records, dtype=Emitter)


def lamp(origin=HERE, at=LAMP, power=(1.0, 2.0, 3.0)):
    distance = np.linalg.norm(at - origin)
    return {"origin": origin, "direction": (at - origin) / distance, "distance": distance, "power": power}


def maps(center, *, width=WIDTH, peak=20.0):
    """A dim environment as captured, and with a lamp of a smooth shape put back in a direction."""
    rows, columns = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(2 * HEIGHT) + 0.5, indexing="ij")
    directions = latlong.directions(HEIGHT, 2 * HEIGHT, rows, columns)
    captured = np.full((HEIGHT, 2 * HEIGHT, 3), 0.2, np.float32)
    shape = np.clip(1.0 - np.linalg.norm(directions - center, axis=-1) / width, 0.0, None)
    return directions, captured, captured + np.float32(peak * shape[..., None])


def moved(environment, captured, filled, emitters):
    out = wp.zeros((HEIGHT, 2 * HEIGHT), wp.vec3)
    places = wp.array(np.float32([[*HERE, 1.0], [*THERE, 1.0]]), wp.vec4)
    given = [wp.array(np.float32(each), wp.vec3) for each in (filled, environment, captured)]
    relocate(*given, emitters, places, out, ball=1)
    return out.numpy().astype(np.float64)


def test_emitters_are_where_another_ball_sees_them(device):
    """A near one by its place, its power by the square of distances; distant ones and none as they are."""
    far = {"origin": HERE, "direction": (0.0, 0.6, 0.8), "distance": np.inf, "power": (1.0, 1.0, 1.0)}
    given, out = emitter_records(lamp(), far), emitter_records()
    move_emitters(given, wp.array(np.float32([[*HERE, 1.0], [*THERE, 1.0]]), wp.vec4), out, ball=1)
    near, distant, none, _ = out.numpy()
    away = np.linalg.norm(LAMP - THERE)
    np.testing.assert_allclose(near["origin"] + near["distance"] * near["direction"], LAMP, atol=ROUNDING)
    np.testing.assert_allclose(near["origin"], THERE, atol=ROUNDING)
    np.testing.assert_allclose(near["power"], np.array([1.0, 2.0, 3.0]) * (0.5 / away) ** 2, rtol=1e-5)
    assert distant == given.numpy()[1]
    assert none["distance"] == 0.0


def test_a_near_lamp_stands_where_the_other_ball_sees_it_with_its_energy_there(device):
    directions, captured, environment = maps(lamp()["direction"])
    excess = moved(environment, captured, captured, emitter_records(lamp())) - 0.2
    toward = (LAMP - THERE) / np.linalg.norm(LAMP - THERE)
    area = latlong.solid_angles(HEIGHT, 2 * HEIGHT)[..., None]
    area = np.broadcast_to(area, excess.shape)
    middle = (excess * area * directions).sum((0, 1))
    assert np.linalg.norm(middle / np.linalg.norm(middle) - toward) < ENERGY * WIDTH
    before = ((environment - captured) * area).sum((0, 1))
    gain = (0.5 / np.linalg.norm(LAMP - THERE)) ** 2
    np.testing.assert_allclose((excess * area).sum((0, 1)), gain * before, rtol=ENERGY)


@pytest.mark.parametrize("known", [False, True])
def test_what_has_no_place_stays_in_its_direction(device, known):
    """To the bit where nothing is turned; what the other ball captured stays as it was."""
    _, captured, environment = maps(np.array([0.0, -0.6, 0.8]))
    filled = np.random.default_rng(2).uniform(0.0, 1.0, captured.shape).astype(np.float32)
    found = moved(environment, captured, filled, emitter_records() if known else None)
    # A place in a map of 128 columns is known to 8e-6 of a texel, over which this lamp changes by 6.5.
    np.testing.assert_allclose(found, filled + (environment - captured), atol=6e-5 if known else 0.0)


def test_nothing_is_taken_away(device):
    """A map that is darker than what was captured, as where it has just moved on, gives no negative light."""
    _, captured, environment = maps(np.array([0.0, -0.6, 0.8]))
    found = moved(captured, environment, captured, None)
    np.testing.assert_array_equal(found, captured)
