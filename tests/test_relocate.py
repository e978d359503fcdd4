"""What was recovered in one ball's map, as another ball sees it."""

import numpy as np
import warp as wp

from tests.reference import latlong
from warp_ar.kernels.recovery.recover_cells import Cell
from warp_ar.kernels.recovery.relocate import move_emitters, relocate, send_recovered, share_recovered
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


CELLS = (16, 32)


def shared(*, clips, lamps, hidden=(), emitters=None, excess=None):
    """A black map in which directions clip, given the radiance of ``lamps``: (cell, share, radiance) of the first."""
    cells, recovered = np.zeros(CELLS, np.dtype(Cell.numpy_dtype())), np.zeros((*CELLS, 3), np.float32)
    cells["solid_angle"] = latlong.solid_angles(*CELLS)
    cells["direction"] = latlong.directions(*CELLS)
    for at, share, radiance in lamps:
        cells["missing"][at], recovered[at] = share, radiance
    for at in hidden:
        cells["hidden"][at] = 1.0
    shape = HEIGHT, 2 * HEIGHT
    share, confidence = np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32)
    for at, value in clips:
        share[at] = value
    first = np.zeros((*shape, 3), np.float32) if excess is None else np.float32(excess)
    own = wp.array(share, wp.vec3), wp.array(confidence, wp.float32)
    out, sent = wp.full(shape, wp.vec3(-1.0), dtype=wp.vec3), wp.full(CELLS, wp.vec3(9.0), dtype=wp.vec3)
    maps = wp.array(first, wp.vec3), wp.zeros(shape, wp.vec3)
    given = wp.array(cells, dtype=Cell)
    send_recovered(*own, given, wp.array(recovered, wp.vec3), sent)
    share_recovered((wp.zeros(shape, wp.vec3), *own), *maps, emitters, given, sent, out)
    return out.numpy()


def test_one_lamp_goes_where_the_other_ball_sees_it_with_all_its_light(device):
    """Shared by what clips there, each channel by its own."""
    clips = [((40, 10), (1.0, 0.5, 0.0)), ((40, 11), (0.5, 0.5, 0.0))]
    excess = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    excess[12:16, 80:84] = 7.0
    found = shared(clips=clips, lamps=[((3, 20), 0.2, (30.0, 20.0, 10.0))], excess=excess)
    area, cell = latlong.solid_angles(HEIGHT, 2 * HEIGHT), latlong.solid_angles(*CELLS)[3, 20]
    moved_there = (found[40, 10:12].astype(np.float64) * area[40, 10:12, None]).sum(0)
    # A few roundings of float32. In blue nothing clips here: that stays where it was found.
    np.testing.assert_allclose(moved_there, 0.2 * cell * np.array([30.0, 20.0, 0.0]), rtol=1e-5)
    np.testing.assert_array_equal(found[12:16, 80:84], np.broadcast_to([0.0, 0.0, 7.0], (4, 4, 3)))
    assert found[40, 10, 0] > 1.9 * found[40, 11, 0]
    found[40, 10:12] = found[12:16, 80:84] = 0.0
    assert not found.any()


def test_of_two_lamps_each_goes_to_the_nearest(device):
    lamps = [((3, 20), 0.2, 30.0), ((9, 2), 0.8, 5.0)]
    places = [(16, 80), (36, 12)]
    found = shared(clips=[(place, 1.0) for place in places], lamps=lamps)
    directions, toward = latlong.directions(*CELLS), latlong.directions(HEIGHT, 2 * HEIGHT)
    area, solid = latlong.solid_angles(HEIGHT, 2 * HEIGHT), latlong.solid_angles(*CELLS)
    expected = np.zeros(2)
    for cell, share, radiance in lamps:
        near = np.array([1.0 / (((toward[at] - directions[cell]) ** 2).sum() + 0.04) ** 2 for at in places])
        own = near * [area[at] for at in places]
        expected += share * radiance * solid[cell] * near / own.sum()
    np.testing.assert_allclose([found[at][0] for at in places], expected, rtol=1e-5)
    alone = [
        share * radiance * solid[cell] / area[at] for (cell, share, radiance), at in zip(lamps, places, strict=True)
    ]
    assert (np.abs(expected / alone - 1.0) < 0.05).all()


def test_what_the_first_ball_does_not_see_is_far(device):
    """Light that was found where it sees nothing stays in its direction."""
    excess = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    excess[12:16, 80:84] = 7.0
    excess[40, 40] = 3.0  # which clips there, and not here
    lamps = [((3, 20), 1.0, 7.0)]
    found = shared(clips=[((40, 40), 1.0)], lamps=lamps, hidden=[(3, 20)], excess=excess)
    np.testing.assert_array_equal(found[12:16, 80:84], 7.0)
    assert found.sum() == found[12:16, 80:84].sum()


def test_where_an_emitter_has_a_place_its_light_is_turned_and_else_nothing_is(device):
    """Of two passes over one map exactly one writes."""
    far = emitter_records({"origin": HERE, "direction": (0.0, 0.6, 0.8), "distance": np.inf, "power": (1.0,) * 3})
    _, captured, environment = maps(np.array([0.0, -0.6, 0.8]))
    for emitters, near in ((emitter_records(lamp()), True), (far, False), (emitter_records(), False)):
        assert (shared(clips=[], lamps=[], emitters=emitters) == -1.0).all() == near
        assert (moved(environment, captured, captured, emitters) == 0.0).all() != near


def test_nothing_is_taken_away(device):
    """A map that is darker than what was captured, as where it has just moved on, gives no negative light."""
    _, captured, environment = maps(np.array([0.0, -0.6, 0.8]))
    found = moved(captured, environment, captured, emitter_records(lamp()))
    np.testing.assert_array_equal(found, captured)
