"""Recovered light follows the card's brightness between estimates."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.recover_rig import DistantLight, cells_of, lit_environment, scene  # noqa: F401
from tests.twins import latlong
from tests.twins import recover as reference
from warp_ar.kernels.recovery.light_level import MOST, STILL, apply_level, follow_level, sum_upward
from warp_ar.kernels.recovery.recover import Observation
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS, Cell
from warp_ar.kernels.recovery.relocate import move_emitters, relocate, send_recovered, share_recovered
from warp_ar.kernels.structs import Emitter
from warp_ar.light.captured import texel_solid_angles
from warp_ar.light.config import CONFIG
from warp_ar.light.estimate import Estimate, FoundEmitter, Seen, Steadiness
from warp_ar.light.priors import connected_regions, depth_profile, least_missing

COUNT = 40
SHARE = 0.4
"""Of the card's light that the map does not show."""
ROUNDING = 1e-5
"""Of float32 ratios."""


def card(radiance=0.3):
    """What points of a card show."""
    observations = np.zeros(COUNT, np.dtype(Observation.numpy_dtype()))
    observations["visible"], observations["radiance"] = 1.0, np.asarray(radiance) * np.ones((COUNT, 3))
    return observations


def level(device, now, then, upward=1.0, share=SHARE, before=1.0):
    """The level that follows, by channel, from ``before``."""
    out = wp.full(3, before, dtype=wp.float32, device=device)
    sides = [wp.array(side, dtype=Observation, device=device) for side in (now, then)]
    sums = tuple(wp.full(3, value, dtype=wp.float32, device=device) for value in (upward, 1.0))
    follow_level(*sides, sums, wp.full(3, share, dtype=wp.float32, device=device), out)
    return out.numpy()


@pytest.mark.parametrize("factor", [0.0, 0.3, 0.8, 1.2, 1.45])
def test_what_the_map_does_not_show_is_followed(device, factor):
    """The card receives a share by light that the map shows, and the rest by light that has changed by a factor."""
    shown = 0.3 * (1.0 - SHARE + SHARE * factor)
    assert level(device, card(shown), card()) == pytest.approx(factor, abs=ROUNDING / SHARE)


@pytest.mark.parametrize("factor", [0.5, 1.4])
def test_light_that_the_map_shows_as_well_changes_no_level(device, factor):
    shown = 0.3 * (factor * (1.0 - SHARE) + SHARE)
    assert level(device, card(shown), card(), upward=factor) == pytest.approx(1.0, abs=1e-6)


def test_noise_is_no_change(device):
    change = 0.9 * float(STILL)
    assert (level(device, card(0.3 * (1.0 + change)), card()) == 1.0).all()
    assert (level(device, card(0.3 * (1.0 - change)), card()) == 1.0).all()
    rng = np.random.default_rng(3)
    noisy = card(0.3 * (1.0 + 0.03 * rng.standard_normal((COUNT, 3))))
    assert (level(device, noisy, card()) == 1.0).all()


def test_a_hand_over_a_part_of_the_card_is_no_light(device):
    """Over a few points it does not count; over many the level stays what it was."""
    now = card(0.3 * (1.0 - SHARE + SHARE * 0.5))
    now["radiance"][:10] = 0.02
    assert level(device, now, card()) == pytest.approx(0.5, abs=ROUNDING / SHARE)
    now["radiance"][:16] = 0.02
    assert (level(device, now, card(), before=0.7) == np.float32(0.7)).all()
    # The median of a graded shadow tells nothing.
    graded = card(0.3 * np.linspace(0.2, 1.0, COUNT)[:, None])
    assert (level(device, graded, card(), before=0.7) == np.float32(0.7)).all()


@pytest.mark.parametrize(
    ("name", "value"), [("visible", 0.5), ("clipped", 0.5), ("radiance", 0.001)], ids=["hidden", "clipped", "dark"]
)
def test_a_card_that_does_not_tell_leaves_the_level(device, name, value):
    silent = card(0.1)
    silent[name] = value
    assert (level(device, silent, card(), before=0.7) == np.float32(0.7)).all()
    assert (level(device, card(), silent, before=0.7) == np.float32(0.7)).all()


def test_what_is_hardly_missing_has_no_level(device):
    assert (level(device, card(0.1), card(), share=0.05, before=0.7) == np.float32(0.7)).all()


def test_a_level_is_bounded(device):
    assert level(device, card(0.9), card(), share=0.1) == pytest.approx(float(MOST))
    assert level(device, card(0.01), card(), share=0.1) == pytest.approx(0.0)


def test_a_uniform_map_gives_pi(device):
    """The sum of cosines over the upper half, by rows: half a row's square off."""
    height = 64
    rows, out = wp.zeros(height // 2, dtype=wp.vec3, device=device), wp.zeros(3, dtype=wp.float32, device=device)
    uniform = wp.full((height, 2 * height), wp.vec3(1.0, 0.5, 0.0), dtype=wp.vec3, device=device)
    sum_upward(uniform, rows, out)
    assert out.numpy() == pytest.approx([np.pi, 0.5 * np.pi, 0.0], rel=(np.pi / height) ** 2)
    below = np.zeros((height, 2 * height, 3), np.float32)
    below[height // 2 :] = 1.0
    sum_upward(wp.array(below, dtype=wp.vec3, device=device), rows, out)
    assert not out.numpy().any()


def test_levels_apply_to_cells_and_emitters(device):
    rng = np.random.default_rng(4)
    cells = rng.uniform(0.0, 5.0, (8, 16, 3)).astype(np.float32)
    emitters = np.zeros(4, np.dtype(Emitter.numpy_dtype()))
    emitters["power"], emitters["distance"] = rng.uniform(0.0, 2.0, (4, 3)), [1.0, 2.0, np.inf, 0.0]
    levels = np.array([0.5, 1.0, 2.0], np.float32)
    shown, moved = wp.zeros((8, 16), dtype=wp.vec3, device=device), wp.zeros(4, dtype=Emitter, device=device)
    given = (wp.array(cells, dtype=wp.vec3, device=device), wp.array(emitters, dtype=Emitter, device=device))
    apply_level(*given, wp.array(levels, device=device), shown, moved)
    assert shown.numpy() == pytest.approx(cells * levels)
    found = moved.numpy()
    assert found["power"] == pytest.approx(emitters["power"] * levels)
    assert (found["distance"] == emitters["distance"]).all()


# --- Means of estimates: noise averages out, light that changes is followed, and so is what tells it ------------------


SHAPE = (4, 8)
STILL_steadiness = CONFIG.solver.still
VIEW = np.array([0.0, -0.6, 0.8])


def seen(level=1.0, told=True):
    """Light on surfaces at a level, in an environment that clips and stays as it is."""
    return Seen(np.ones((*SHAPE, 3)), np.full(20, 0.3 * level), np.full(20, told))


def estimate(value=1.0, power=None, cell=3):
    recovered = np.full((*SHAPE, 3), value, np.float32)
    emitters = ()
    if power is not None:
        emitters = (FoundEmitter(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.5, np.full(3, power), cell),)
    return Estimate(recovered, (False, False, False), emitters, "shading", 1.0)


def test_light_that_stays_becomes_the_mean():
    steadiness, values = Steadiness(), [3.0, 5.0, 4.0, 8.0]
    for count, value in enumerate(values, 1):
        found = steadiness.follow(estimate(value, power=10.0 * value), seen(), VIEW)
        np.testing.assert_allclose(found.recovered, np.mean(values[:count]), rtol=1e-6)
        np.testing.assert_allclose(found.emitters[0].power, 10.0 * np.mean(values[:count]))


@pytest.mark.parametrize("level", [1.0 + 1.1 * STILL_steadiness, 1.0 - 1.1 * STILL_steadiness, 2.0])
def test_light_that_changes_is_followed_at_once(level):
    steadiness = Steadiness()
    for _ in range(30):
        steadiness.follow(estimate(1.0), seen(), VIEW)
    assert steadiness.follow(estimate(5.0), seen(level), VIEW).recovered.max() == 5.0


def test_a_ball_seen_from_elsewhere_is_seen_anew():
    steadiness, aside = Steadiness(), np.array([1.0, 0.0, 0.0])
    for _ in range(5):
        steadiness.follow(estimate(1.0), seen(), VIEW)
    trembled = steadiness.follow(estimate(7.0), seen(), VIEW + 0.2 * STILL_steadiness * aside)
    assert trembled.recovered.max() == pytest.approx(1.0 + 6.0 / 6.0)
    assert steadiness.follow(estimate(7.0), seen(), VIEW + 1.2 * STILL_steadiness * aside).recovered.max() == 7.0


@pytest.mark.parametrize("rate", [0.001, 0.004, 0.01])
def test_light_that_changes_slowly_runs_ahead_by_no_more_than_counts(rate):
    """Each step is less than what counts as a change: the mean must not stay behind for all that."""
    steadiness = Steadiness()
    for step in range(200):
        level = np.exp(rate * step)
        found = steadiness.follow(estimate(level), seen(level), VIEW)
        assert found.recovered.mean() > (1.0 - 1.1 * STILL_steadiness) * level


# What clips is raised, where nothing but the map tells, by how much clips, how many channels do, and how it ends.


SHAPE_LEAST_MISSING = (CELL_ROWS, CELL_COLUMNS)
AREA = np.broadcast_to(texel_solid_angles(CELL_ROWS), SHAPE_LEAST_MISSING)
LEVEL = 1.2
ROUNDING_LEAST_MISSING = 1e-6
EVERYWHERE = np.ones(SHAPE_LEAST_MISSING, bool)
WINDOW = np.zeros(SHAPE_LEAST_MISSING, bool)
WINDOW[8:12, 20:26] = True


def room(clips: np.ndarray = WINDOW, channels: tuple[int, ...] = (0, 1, 2)) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and clipped share of dark walls with something that clips."""
    radiance, clipped = np.full((*SHAPE_LEAST_MISSING, 3), 0.1), np.zeros((*SHAPE_LEAST_MISSING, 3))
    for channel in channels:
        radiance[clips, channel], clipped[clips, channel] = LEVEL, 1.0
    return radiance, clipped


def test_a_window_is_raised_by_the_root_of_how_much_clips() -> None:
    """Even, in all of it, and nothing else is; a quarter of the solid angle has less by the rule's power."""
    config, half = CONFIG.least, WINDOW.copy()
    half[:, 23:] = False
    found = least_missing(*room(), AREA, EVERYWHERE)
    expected = config.least * AREA[WINDOW].sum() ** config.exponent * LEVEL
    assert found[WINDOW] == pytest.approx(expected, rel=ROUNDING_LEAST_MISSING)
    assert not found[~WINDOW].any()
    less = least_missing(*room(half), AREA, EVERYWHERE)[half]
    assert less == pytest.approx(expected * 0.5**config.exponent, rel=ROUNDING_LEAST_MISSING)


# --- By how much what clips is expected to exceed clipping, by what the captured map shows around it ------------------


SHAPE_CLIPPING_PRIOR = (CELL_ROWS, CELL_COLUMNS)
CENTER = (-0.5, -0.6, 0.6)


def patch(around, radius=0.5, center=CENTER, level=1.0):
    """Cells of which those within ``radius`` radians of a direction clip, its nearest neighbours at ``around``."""
    d, area = reference.cell_directions(*SHAPE_CLIPPING_PRIOR)
    angle = np.arccos(np.clip(d @ (np.array(center) / np.linalg.norm(center)), -1.0, 1.0))
    inside = angle < radius
    values, _ = cells_of("cpu")
    values["radiance"] = level * np.where(inside, 1.0, around).reshape(*SHAPE_CLIPPING_PRIOR, 1)
    values["clipped"] = values["missing"] = inside.reshape(*SHAPE_CLIPPING_PRIOR, 1)
    component = connected_regions(inside.reshape(SHAPE_CLIPPING_PRIOR)).ravel()
    return values, component, inside, angle, area


@pytest.mark.parametrize("level", [1.0, 0.6, 1.18])
def test_what_is_missing_grows_inward_from_where_light_fades(level):
    """At any level of clipping: a ball reflects but a part."""
    values, component, inside, angle, area = patch(0.85, level=level)
    profile = depth_profile(values, component)
    assert (profile[~inside] == 1.0).all()
    mean = area[inside] @ profile[inside] / area[inside].sum()
    assert mean == pytest.approx(np.ones(3))
    for c in range(3):
        assert np.corrcoef(profile[inside, c], -angle[inside])[0, 1] > 0.95
    assert profile[angle < 0.1].mean() > 4.0 * profile[inside & (angle > 0.45)].mean()


def test_a_sky_around_the_sun_comes_out_bright_in_its_middle(device, scene):
    """The card's light is right, and the middle of the sky lacks more than its boundary, as it does."""
    radiance, (sky, _), area = lit_environment((CENTER, np.cos(0.75), 0.9), (CENTER, np.cos(0.5), 1.5))
    d, _ = reference.cell_directions(*SHAPE_CLIPPING_PRIOR)
    angle = np.arccos(np.clip(d @ (np.array(CENTER) / np.linalg.norm(CENTER)), -1.0, 1.0))
    inside = sky & (angle < 0.5)
    radiance[inside] = 1.0 + 20.0 * np.maximum(0.5 - angle[inside], 0.02)[:, None] ** 2
    estimate, values = DistantLight(device, scene, noise=0.1).estimate(radiance)
    recovered = (estimate.recovered * values["missing"]).reshape(-1, 3).astype(float)
    upward = area * np.maximum(d[:, 2], 0.0)
    assert upward @ recovered == pytest.approx(upward @ np.maximum(radiance - 1.0, 0.0), rel=0.1)
    off = [np.linalg.norm((area[:, None] * (one - np.maximum(radiance - 1.0, 0.0)))[inside]) for one in (recovered, 0)]
    assert off[0] < 0.5 * off[1]
    assert recovered[inside & (angle < 0.15)].mean() > 3.0 * recovered[inside & (angle > 0.4)].mean()


# --- What was recovered in one ball's map, as another ball sees it ----------------------------------------------------


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
ROUNDING_RELOCATE = 1e-6


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
    relocate(*given, emitters, places, 1, out)
    return out.numpy().astype(np.float64)


def test_emitters_are_where_another_ball_sees_them(device):
    """A near one by its place, its power by the square of distances; distant ones and none as they are."""
    far = {"origin": HERE, "direction": (0.0, 0.6, 0.8), "distance": np.inf, "power": (1.0, 1.0, 1.0)}
    given, out = emitter_records(lamp(), far), emitter_records()
    move_emitters(given, wp.array(np.float32([[*HERE, 1.0], [*THERE, 1.0]]), wp.vec4), out, ball=1)
    near, distant, none, _ = out.numpy()
    away = np.linalg.norm(LAMP - THERE)
    np.testing.assert_allclose(near["origin"] + near["distance"] * near["direction"], LAMP, atol=ROUNDING_RELOCATE)
    np.testing.assert_allclose(near["origin"], THERE, atol=ROUNDING_RELOCATE)
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
    share_recovered(wp.zeros(shape, wp.vec3), *own, *maps, emitters, given, sent, out)
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


def test_what_the_first_ball_does_not_see_is_far(device):
    """Light that was found where it sees nothing stays in its direction."""
    excess = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    excess[12:16, 80:84] = 7.0
    excess[40, 40] = 3.0  # which clips there, and not here
    lamps = [((3, 20), 1.0, 7.0)]
    found = shared(clips=[((40, 40), 1.0)], lamps=lamps, hidden=[(3, 20)], excess=excess)
    np.testing.assert_array_equal(found[12:16, 80:84], 7.0)
    assert found.sum() == found[12:16, 80:84].sum()
