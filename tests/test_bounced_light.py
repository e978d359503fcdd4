"""One bounce of virtual light between the surfaces of the desk: patches that send, cells that receive."""

import numpy as np
import pytest

from tests.error_model import check_error
from tests.kernel_rig import shape
from tests.receiver_cells_rig import FOCAL, PATCHES, WHITE, View, middles, patches_of
from tests.relight_rig import CAMERA, FLOAT_ERROR, POINTS, point
from tests.twins import receiver_cells as reference
from warp_ar.kernels.receiver import receiver_cells
from warp_ar.kernels.structs import PLANE
from warp_ar.scene.geometry import rotation_matrix

# --- Bounced light: closed forms --------------------------------------------------------------------------------------


def test_at_the_edge_of_a_lit_strip(device):
    """Two faces at right angles: the desk, and at x = -0.45 a wall of which a strip of 0.2 is lit, 8 m long."""
    size = 0.01
    z, y = np.meshgrid(np.arange(size / 2, 0.2, size), np.arange(-4, 4, size) + size / 2)
    positions = np.stack([np.full(z.size, -0.45), y.ravel(), z.ravel()], -1)
    bounced, _ = View().gather(patches_of(positions, (1, 0, 0), WHITE, size**2), patch_stride=48, stride=8)
    expected = np.pi * reference.strip_form_factor(POINTS[middles(8)][..., 0] + 0.45, 0.2)
    np.testing.assert_allclose(bounced, np.broadcast_to(expected[..., None], bounced.shape), rtol=PATCHES)


def test_nothing_receives_more_than_a_white_sky_of_its_radiance(device):
    """A patch as near as 1 mm, 100 times as large as it is far: pi L and no more, as a point it would give 10,000 L."""
    bounced, _ = View(size=(5, 5), surroundings=0 * WHITE).gather(
        patches_of((0, 0, 1e-3), (0, 0, -1), WHITE, 1e-2), patch_stride=5, stride=1
    )
    assert 0.99 * np.pi < bounced.max() <= np.pi * (1 + FLOAT_ERROR)


@pytest.mark.parametrize(("height", "area"), [(0.06, 1e-4), (0.005, 1e-2), (1e-3, 1.0)])
def test_no_more_is_received_than_sent(device, height, area):
    """A patch of pi L A watts: from the frame, nearly all that a small one sees, comes nearly all."""
    patch = patches_of((0, 0, height), (0, 0, -1), WHITE, area)
    bounced, _ = View(size=(96, 128), surroundings=0 * WHITE).gather(patch, patch_stride=96, stride=1)
    received = bounced[..., 0].sum() * (CAMERA[2] / FOCAL) ** 2
    assert received <= np.pi * area
    if area < height**2:
        assert received > 0.95 * np.pi * area


@pytest.mark.parametrize("seed", range(2))
def test_a_flat_surface_does_not_light_itself(device, seed):
    """However it stands, and 100 m away: what rounding puts above a point turns its back on it."""
    rng = np.random.default_rng(seed)
    turn = rotation_matrix((*rng.uniform(-30, 30, 2), rng.uniform(0, 360)))
    shift = np.array([60.0, -80.0, 0]) * (seed % 2)
    slab = {**shape(PLANE, shift, (5, 5, 0)), "rotation": turn}
    view = View(
        (slab,),
        surroundings=0 * WHITE,
        lights=[point(shift + np.array([0, 0, 0.3]), (50.0,) * 3)],
        camera=CAMERA + shift,
    )
    bounced, surface = view.gather(view.send(4))
    assert (surface == 0).all()
    assert (bounced == 0).all()


def test_gather_matches_twin(device):
    rng = np.random.default_rng(2)
    positions = rng.uniform((-0.3, -0.3, -0.05), (0.3, 0.3, 0.4), (300, 3))
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    radiance, areas = rng.uniform(0, 1, (300, 3)), rng.uniform(1e-5, 1e-2, 300)
    bounced, _ = View(surroundings=0 * WHITE).gather(patches_of(positions, normals, radiance, areas), patch_stride=48)
    points = POINTS[middles(4)].reshape(-1, 3)
    up = np.broadcast_to((0, 0, 1.0), points.shape)
    expected = reference.gather_light(points, up, positions, normals, radiance * areas[:, None], areas)
    check_error("relight", bounced.reshape(-1, 3), expected)
    assert expected.max() > 0.1


def test_what_no_picture_shows_is_none(device):
    """Over the environment by less than 1 / 1024: nothing; in the dark every bit counts."""
    patch = patches_of((0, 0, 0.3), (0, 0, -1), WHITE, 1e-4)
    lit = View(surroundings=0 * WHITE).gather(patch, patch_stride=48)[0]
    kept = View(surroundings=WHITE).gather(patch, patch_stride=48)[0]
    limit = float(receiver_cells.NEGLIGIBLE) * np.pi
    assert (lit > 0).all()
    assert (lit < 0.9 * limit).any()
    assert (kept[lit < 0.999 * limit] == 0).all()
    bright = patches_of((0, 0, 0.3), (0, 0, -1), 100 * WHITE, 1e-4)
    np.testing.assert_array_equal(
        View(surroundings=WHITE).gather(bright, patch_stride=48)[0],
        View(surroundings=0 * WHITE).gather(bright, patch_stride=48)[0],
    )


# --- Patches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(48, 64), (47, 61), (1, 1), (3, 50)])
@pytest.mark.parametrize("stride", [1, 4, 16])
def test_patches_cover_what_the_frame_shows(device, size, stride):
    """Looking straight down, areas sum to the desk's in the picture, patches at the border are smaller."""
    sent = View(size=size).send(stride).numpy()
    pixel = (CAMERA[2] / FOCAL) ** 2
    # Toward the corners a pixel shows the same area of the desk: t^2 cos / (f^2 cos).
    assert sent["area"].sum() == pytest.approx(size[0] * size[1] * pixel, rel=1e-5)
    np.testing.assert_allclose(sent["normal"].reshape(-1, 3), np.broadcast_to((0, 0, 1), (sent.size, 3)))
