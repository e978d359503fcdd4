"""Environments in other programs' axes: every direction keeps its radiance, by each program's own formula."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warp_ar.errors import UsageError
from warp_ar.output.environment_axes import (
    AXES,
    CUBES,
    cube_directions,
    from_axes,
    sample_latlong,
    to_axes,
    to_cube,
    world_from_marker,
)

HEIGHT = 32
EXACT = 1e-5  # float32 of the map
# A bilinear sample of a smooth function: curvature times the square of a texel, (pi / 32)^2 / 8 each way; at a cube's
# texel the mean over it as well.
SMOOTH = 0.01
WORLD_Y_UP = {"y-up", "opengl"}


def linear(directions: np.ndarray) -> np.ndarray:
    """A radiance that tells a direction: 2 + x, 2 + y, 2 + z of the marker's axes."""
    return (2.0 + directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)


def own_map(height: int = HEIGHT) -> np.ndarray:
    theta = (np.arange(height)[:, None] + 0.5) / height * math.pi
    phi = ((np.arange(2 * height)[None] + 0.5) / height - 1.0) * math.pi
    s = np.sin(theta)
    return linear(np.stack([s * np.cos(phi), s * np.sin(phi), np.cos(theta) + 0 * phi], -1))


def exr_latlong(height: int) -> np.ndarray:
    """OpenEXR: longitude from +pi on the left to -pi, x = sin lon cos lat, y = sin lat, z = cos lon cos lat."""
    latitude = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * math.pi
    longitude = (0.5 - (np.arange(2 * height)[None] + 0.5) / (2 * height)) * 2 * math.pi
    c = np.cos(latitude)
    return np.stack([np.sin(longitude) * c, np.sin(latitude) + 0 * longitude, np.cos(longitude) * c], -1)


def blender_latlong(height: int) -> np.ndarray:
    """Cycles: phi = pi - 2 pi u, theta from +z at the top."""
    theta = (np.arange(height)[:, None] + 0.5) / height * math.pi
    phi = math.pi - 2 * math.pi * (np.arange(2 * height)[None] + 0.5) / (2 * height)
    s = np.sin(theta)
    return np.stack([s * np.cos(phi), s * np.sin(phi), np.cos(theta) + 0 * phi], -1)


def three_latlong(height: int) -> np.ndarray:
    """three.js: u = atan2(z, x) / 2 pi + 0.5, v = asin(y) / pi + 0.5 from the bottom."""
    phi = ((np.arange(2 * height)[None] + 0.5) / (2 * height) - 0.5) * 2 * math.pi
    latitude = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * math.pi
    c = np.cos(latitude)
    return np.stack([c * np.cos(phi), np.sin(latitude) + 0 * phi, c * np.sin(phi)], -1)


def opengl_latlong(height: int) -> np.ndarray:
    """Looks along -z at the centre, to +x on the right."""
    phi = ((np.arange(2 * height)[None] + 0.5) / (2 * height) - 0.5) * 2 * math.pi
    latitude = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * math.pi
    c = np.cos(latitude)
    return np.stack([c * np.sin(phi), np.sin(latitude) + 0 * phi, -c * np.cos(phi)], -1)


def marker_from(y_up: np.ndarray) -> np.ndarray:
    """The marker's x, y, z of a world that has them as x, z, -y."""
    x, y, z = np.moveaxis(y_up, -1, 0)
    return np.stack([x, -z, y], -1)


@pytest.mark.parametrize(
    ("axes", "directions"),
    [
        ("y-up", marker_from(exr_latlong(HEIGHT))),
        ("blender", blender_latlong(HEIGHT)),
        ("blender", marker_from(three_latlong(HEIGHT))),
        ("opengl", marker_from(opengl_latlong(HEIGHT))),
    ],
    ids=["openexr", "blender", "three.js", "opengl"],
)
def test_a_latlong_holds_each_direction_where_its_program_looks(axes: str, directions: np.ndarray) -> None:
    np.testing.assert_allclose(to_axes(own_map(), axes), linear(directions), atol=EXACT)


@pytest.mark.parametrize("axes", AXES)
def test_there_and_back_is_the_same_to_the_bit(axes: str) -> None:
    noise = np.random.default_rng(1).random((6, 12, 3)).astype(np.float32)
    np.testing.assert_array_equal(from_axes(to_axes(noise, axes), axes), noise)


@pytest.mark.parametrize("axes", AXES)
def test_worlds_are_turned_not_mirrored(axes: str) -> None:
    rotation = world_from_marker(axes)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    up = (0, 1, 0) if axes in WORLD_Y_UP else (0, 0, 1)
    np.testing.assert_array_equal(rotation @ (0, 0, 1), up)


def exr_cube(size: int) -> np.ndarray:
    """``ImfEnvmap``: pixel of a position in a face, and direction of the position, inverted."""
    p = (np.arange(size) + 0.5) / size * 2 - 1
    right, down = np.meshgrid(p, p)
    one = np.ones_like(right)
    faces = [(one, -down, right), (-one, -down, -right), (right, one, -down)]
    faces += [(right, -one, down), (-right, -down, one), (right, -down, -one)]
    return np.stack([np.stack(face, -1) for face in faces])


def gl_cube(size: int) -> np.ndarray:
    """OpenGL's table 8.19: s = sc / |ma|, t = tc / |ma|, row 0 at t = 0."""
    p = (np.arange(size) + 0.5) / size * 2 - 1
    sc, tc = np.meshgrid(p, p)
    one = np.ones_like(sc)
    faces = [(one, -tc, -sc), (-one, -tc, sc), (sc, one, tc)]
    faces += [(sc, -one, -tc), (sc, -tc, one), (-sc, -tc, -one)]
    return np.stack([np.stack(face, -1) for face in faces])


@pytest.mark.parametrize(("axes", "directions"), [("y-up", exr_cube(8)), ("opengl", gl_cube(8))])
def test_a_cubes_faces_lie_as_its_program_has_them(axes: str, directions: np.ndarray) -> None:
    np.testing.assert_allclose(cube_directions(axes, 8), directions, atol=EXACT)
    faces = to_cube(own_map(), axes, 8).reshape(6, 8, 8, 3)
    np.testing.assert_allclose(faces, linear(marker_from(directions)), atol=SMOOTH)


def test_neighbouring_faces_meet() -> None:
    """Of OpenEXR's faces: the right edge of +z, as seen from inside, is the left edge of -x."""
    faces = cube_directions("y-up", 4, 0.5, 1.0)
    np.testing.assert_allclose(faces[4, :, 3], cube_directions("y-up", 4, 0.5, 0.0)[1, :, 0], atol=EXACT)


@pytest.mark.parametrize("axes", CUBES)
def test_a_constant_environment_is_a_constant_cube(axes: str) -> None:
    cube = to_cube(np.full((8, 16, 3), 0.7, np.float32), axes)
    assert cube.shape == (24, 4, 3)
    np.testing.assert_allclose(cube, 0.7, atol=EXACT)


def test_samples_are_exact_at_texel_centres_and_continuous_at_seam_and_pole() -> None:
    noise = np.random.default_rng(2).random((8, 16, 3)).astype(np.float32)
    directions = from_axes(blender_latlong(8).astype(np.float32), "blender").astype(np.float64)
    np.testing.assert_allclose(sample_latlong(noise, directions), noise, atol=EXACT)
    near = 1e-7
    for a, b in (((-1, near, 0.3), (-1, -near, 0.3)), ((near, 0, 1), (-near, 0, 1)), ((0, near, -1), (0, -near, -1))):
        np.testing.assert_allclose(
            sample_latlong(noise, np.array(a, float)), sample_latlong(noise, np.array(b, float)), atol=EXACT
        )


def test_what_cannot_be_is_said() -> None:
    flat = own_map(4)
    with pytest.raises(UsageError, match=r"axes 'x-up': expected z-up, blender, y-up, opengl for a latlong"):
        to_axes(flat, "x-up")
    with pytest.raises(UsageError, match="axes 'z-up': expected y-up, opengl for a cube"):
        to_cube(flat, "z-up")
    with pytest.raises(UsageError, match="10 columns has no whole quarter"):
        to_axes(own_map(5), "opengl")
    with pytest.raises(UsageError, match="size 0"):
        to_cube(flat, "y-up", 0)


def test_a_cube_that_no_memory_holds_is_refused():
    """Before anything is allocated: of six faces of 10^9 texels a side NumPy itself gave a traceback."""
    with pytest.raises(UsageError, match=r"a cube of size 1000000000 has 6,000,000,000,000,000,000 texels; at most"):
        to_cube(np.ones((4, 8, 3), np.float32), "y-up", 1_000_000_000)
