"""By how much what clips is expected to exceed clipping, by what the captured map shows around it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.recover_rig import DistantLight, cells_of, lit_environment, scene  # noqa: F401
from tests.reference import recover as reference
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS
from warp_ar.light.clipping_prior import alike, depth_profile
from warp_ar.light.config import CONFIG
from warp_ar.light.regions import connected_regions

SHAPE = (CELL_ROWS, CELL_COLUMNS)
CENTER = (-0.5, -0.6, 0.6)


def patch(around, radius=0.5, center=CENTER, level=1.0):
    """Cells of which those within ``radius`` radians of a direction clip, its nearest neighbours at ``around``."""
    d, area = reference.cell_directions(*SHAPE)
    angle = np.arccos(np.clip(d @ (np.array(center) / np.linalg.norm(center)), -1.0, 1.0))
    inside = angle < radius
    values, _ = cells_of("cpu")
    values["radiance"] = level * np.where(inside, 1.0, around).reshape(*SHAPE, 1)
    values["clipped"] = values["missing"] = inside.reshape(*SHAPE, 1)
    component = connected_regions(inside.reshape(SHAPE)).ravel()
    return values, component, inside, angle, area


def test_a_component_counts_by_the_share_that_clips_in_all_channels():
    clipped = np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [1, 0, 0], [1, 0, 0], [0.5, 0.2, 1]], float)
    area = np.array([1.0, 2.0, 1.0, 3.0, 5.0, 1.0])
    component = np.array([0, 0, 1, 1, 2, -1])
    assert alike(clipped, area, component, 3) == pytest.approx([1.0, 0.25**2, CONFIG.priors.least_alike])


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


@pytest.mark.parametrize("around", [0.05, 0.5])
def test_a_window_lacks_as_much_at_its_frame(around):
    values, component, *_ = patch(around)
    assert (depth_profile(values, component) == 1.0).all()


def test_depth_counts_from_the_side_that_fades():
    """A sky above a dark horizon is deepest at the horizon."""
    values, component, inside, _, _ = patch(0.85, radius=0.6, center=(-1.0, 0.0, 0.05))
    d, _ = reference.cell_directions(*SHAPE)
    ground = (d[:, 2] < 0.0).reshape(SHAPE)
    values["radiance"][ground], values["clipped"][ground], values["missing"][ground] = 0.2, 0.0, 0.0
    component = np.where(ground.ravel(), -1, component)
    profile = depth_profile(values, component)[:, 0]
    sky = np.flatnonzero(inside & ~ground.ravel())
    assert d[sky[np.argmax(profile[sky])], 2] < 0.1


def test_the_profile_is_continuous_in_what_stands_beside():
    """What fades a little more or less does not turn one kind of boundary into the other."""
    largest = []
    for count in (41, 161):
        profiles = [depth_profile(*patch(around)[:2]) for around in np.linspace(0.55, 0.75, count)]
        assert not np.allclose(profiles[0], profiles[-1])
        largest.append(max(np.abs(after - before).max() for before, after in itertools.pairwise(profiles)))
    # A step that were one would be as large by finer steps.
    assert largest[1] < 0.4 * largest[0]


def test_nothing_clips_nothing_is_shared():
    values, _ = cells_of("cpu", radiance=0.5)
    assert (depth_profile(values, np.full(values.size, -1)) == 1.0).all()
    assert alike(np.zeros((4, 3)), np.ones(4), np.full(4, -1), 0).shape == (0,)


def test_a_sky_around_the_sun_comes_out_bright_in_its_middle(device, scene):
    """The card's light is right, and the middle of the sky lacks more than its boundary, as it does."""
    radiance, (sky, _), area = lit_environment((CENTER, np.cos(0.75), 0.9), (CENTER, np.cos(0.5), 1.5))
    d, _ = reference.cell_directions(*SHAPE)
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
