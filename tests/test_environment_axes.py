"""Environments in other programs' axes: every direction keeps its radiance, by each program's own formula."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import struct

import cv2
import numpy as np
import OpenEXR
import pytest

from warp_ar import environment
from warp_ar.errors import UsageError
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.light.latlong_axes import AXES, from_axes, to_axes
from warp_ar.output.environment_axes import (
    cube_directions,
    encode_harmonics,
    sample_latlong,
    to_cube,
)
from warp_ar.output.environment_file import EnvironmentInfo, read_environment_info, write_environment
from warp_ar.output.gltf_environment import EXTENSION, LARGEST, encode_rgbd, irradiance_coefficients, specular_cubes
from warp_ar.output.gltf_file import write_glb
from warp_ar.output.shot import Shot
from warp_ar.scene import Pose, load_scene

HEIGHT = 32
EXACT = 1e-5  # float32 of the map
# A bilinear sample of a smooth function: curvature times the square of a texel, (pi / 32)^2 / 8 each way; at a cube's
# texel the mean over it as well.
SMOOTH = 0.01


def linear(directions: np.ndarray) -> np.ndarray:
    """A radiance that tells a direction: 2 + x, 2 + y, 2 + z of the marker's axes."""
    return (2.0 + directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)


def own_map(height: int = HEIGHT) -> np.ndarray:
    return linear(latlong_directions(height))


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
    with pytest.raises(UsageError, match="10 columns cannot be turned"):
        to_axes(own_map(5), "opengl")
    with pytest.raises(UsageError, match="size 0"):
        to_cube(flat, "y-up", 0)


# --- Spherical harmonics: closed forms, and another way to the same sums ----------------------------------------------


def noise() -> np.ndarray:
    return np.random.default_rng(3).random((8, 16, 3)).astype(np.float32)


def test_the_frames_own_harmonics_agree(device: str) -> None:
    """The kernel that frames are lit by has the same basis, order and lobe."""
    import warp as wp

    from warp_ar.kernels.environment.irradiance import make_sh_tables, project_irradiance_sh

    radiance = wp.array(noise(), dtype=wp.vec3, device=device)
    tables = make_sh_tables(8, 16, device)
    out = wp.zeros(9, dtype=wp.vec3, device=device)
    rows = wp.zeros((8, 5), dtype=wp.vec3, device=device)
    project_irradiance_sh(radiance, tables, rows, out)
    content = json.loads(encode_harmonics(noise(), "z-up", 1.0))
    np.testing.assert_allclose(out.numpy(), content["irradiance"], atol=1e-4)


# --- The command that writes an environment for another program -------------------------------------------------------


@pytest.fixture
def captured(tmp_path: pathlib.Path) -> pathlib.Path:
    path = tmp_path / "captured.exr"
    light = np.random.default_rng(0).random((8, 16, 3), np.float32)
    write_environment(path, light, info=EnvironmentInfo(exposure=0.5))
    return path


def pixels(path: pathlib.Path) -> np.ndarray:
    with OpenEXR.File(str(path)) as file:
        return np.array(file.channels()["RGB"].pixels)


def test_axes_time_and_place_are_written(captured: pathlib.Path) -> None:
    output = captured.parent / "new" / "out.exr"
    where = ["--place", "13.4", "52.5", "34", "--taken", "2026-05-01T12:00:00+02:00"]
    assert environment.main([str(captured), "--output", str(output), *where]) == 0
    np.testing.assert_array_equal(pixels(output), to_axes(pixels(captured), "y-up"))
    info = read_environment_info(output)
    assert (info.exposure, info.place[2]) == (0.5, 34.0)
    assert info.taken.isoformat() == "2026-05-01T10:00:00+00:00"


def test_a_cube_has_the_size_asked_for(captured: pathlib.Path) -> None:
    output = captured.parent / "out.exr"
    assert environment.main([str(captured), "--output", str(output), "--layout", "cube", "--size", "5"]) == 0
    assert pixels(output).shape == (30, 5, 3)


# --- The environment within a glTF: its faces, its roughness, its harmonics, against sums that are written out here ---


RGBD = 0.02  # a step of 8 bits in the brightest channel's 2.2th power, and of D's whole steps
MONTE_CARLO_GLTF_ENVIRONMENT = 5.0  # standard errors
# Directions that faces of a cube look along, as glTF's picture of the extension has them.
FACES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def y_up(direction: tuple[float, float, float]) -> np.ndarray:
    """The marker's direction of one of glTF's world: y up is z up."""
    x, y, z = direction
    return np.array([x, -z, y], float)


def glowing(toward: np.ndarray, height: int = 64) -> np.ndarray:
    """A smooth light around a direction."""
    cos_theta = latlong_directions(height) @ (toward / np.linalg.norm(toward))
    return (0.2 + 5.0 * np.exp(8.0 * (cos_theta - 1.0)))[..., None].astype(np.float32) * np.float32([1.0, 0.5, 0.25])


@pytest.mark.parametrize("face", range(6))
def test_faces_look_where_they_should(face: int) -> None:
    cubes = specular_cubes(glowing(y_up(FACES[face])))
    assert [cube.shape for cube in cubes] == [(6, size, size, 3) for size in (64, 32, 16)]
    for cube in cubes:
        assert cube[:, :, :, 0].reshape(6, -1).mean(1).argmax() == face


def test_faces_are_mirrored_as_the_extension_asks() -> None:
    """A light toward +z, a little to +x: on OpenGL's face +z, s grows toward +x; in the file it falls."""
    sharp = specular_cubes(glowing(y_up((0.6, 0.0, 1.0))))[0]
    row, column = np.unravel_index(sharp[4, :, :, 0].argmax(), (LARGEST, LARGEST))
    assert column == pytest.approx((1.0 - 0.6) / 2.0 * LARGEST, abs=1.5)
    assert row == pytest.approx(LARGEST / 2, abs=1.5)


def test_roughness_is_ggx() -> None:
    """By half vectors drawn from GGX itself, about the normal that is the direction of view."""
    radiance = glowing(np.array([1.0, 0.3, 0.4]), 32)
    cube = specular_cubes(radiance)[1]
    alpha, size, rng = 0.25, cube.shape[1], np.random.default_rng(0)
    u, v = rng.uniform(size=(2, 200_000))
    cos_half = np.sqrt((1.0 - u) / (1.0 + (alpha**2 - 1.0) * u))
    sin_half = np.sqrt(1.0 - cos_half**2)
    half = np.stack([sin_half * np.cos(2 * math.pi * v), sin_half * np.sin(2 * math.pi * v), cos_half], -1)
    local = 2.0 * cos_half[:, None] * half - np.array([0.0, 0.0, 1.0])
    # The middle of face +x, half a texel off.
    normal = y_up((1.0, -1.0 / size, 1.0 / size))
    normal /= np.linalg.norm(normal)
    side = np.cross([0.0, 0.0, 1.0], normal)
    side /= np.linalg.norm(side)
    toward = local @ np.stack([side, np.cross(normal, side), normal])
    weight = np.maximum(local[:, 2], 0.0)
    peak = np.array([1.0, 0.3, 0.4]) / np.linalg.norm([1.0, 0.3, 0.4])
    seen = 0.2 + 5.0 * np.exp(8.0 * (toward @ peak - 1.0))
    expected = (seen * weight).sum() / weight.sum()
    error = math.sqrt(((seen - expected) ** 2 * weight**2).sum()) / weight.sum()
    # File's column: mirrored; +x looks with s along -z.
    found = cube[0, size // 2, size // 2, 0]
    assert found == pytest.approx(expected, abs=MONTE_CARLO_GLTF_ENVIRONMENT * error + 0.01 * expected)


def test_harmonics_give_irradiance_with_their_signs() -> None:
    radiance = glowing(np.array([0.3, -0.5, 0.8]))
    coefficients = irradiance_coefficients(radiance)
    toward = latlong_directions(64).reshape(-1, 3)
    area = np.broadcast_to(texel_solid_angles(64), (64, 128)).reshape(-1)
    for direction in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-0.6, 0.48, 0.64)):
        cos_theta = np.clip(toward @ y_up(direction), 0.0, None)
        expected = (cos_theta * area) @ radiance.reshape(-1, 3).astype(float)
        x, y, z = direction
        first = (0.282095, -0.488603 * y, 0.488603 * z, -0.488603 * x)
        second = (1.092548 * x * y, -1.092548 * y * z, 0.315392 * (3 * z * z - 1), -1.092548 * x * z)
        basis = np.array((*first, *second, 0.546274 * (x * x - y * y)))
        # Nine harmonics leave 1 % of a cosine lobe's irradiance in the mean, some percent beside a light [RH01].
        np.testing.assert_allclose(basis @ coefficients, expected, rtol=0.06)


def test_pixels_are_rgbd() -> None:
    radiance = np.random.default_rng(1).uniform(0.0, 1.0, (8, 8, 3)).astype(np.float32) ** 3 * 40.0
    codes = (
        cv2.imdecode(np.frombuffer(encode_rgbd(radiance), np.uint8), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]] / 255.0
    )
    decoded = codes[..., :3] ** 2.2 / codes[..., 3:]
    assert (np.abs(decoded - radiance) <= RGBD * radiance.max(-1, keepdims=True) + 1e-3).all()


def test_a_file_holds_it(tmp_path) -> None:
    scene = load_scene("desk")
    radiance = glowing(np.array([0.0, 0.0, 1.0]))
    shot = Shot(scene, 30.0, (Pose(np.eye(3), np.array([0.0, 0.0, 1.0])),), radiance=radiance)
    write_glb(tmp_path / "shot.glb", shot)
    data = (tmp_path / "shot.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    tree, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert EXTENSION in tree["extensionsUsed"]
    assert tree["scenes"][0]["extensions"][EXTENSION] == {"light": 0}
    light = tree["extensions"][EXTENSION]["lights"][0]
    assert np.shape(light["irradianceCoefficients"]) == (9, 3)
    assert np.shape(light["specularImages"]) == (3, 6)
    up = tree["images"][light["specularImages"][0][2]]
    view = tree["bufferViews"][up["bufferView"]]
    png = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    face = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert face.shape == (LARGEST, LARGEST, 4)
    assert (face[32, 32, 2] / 255.0) ** 2.2 / (face[32, 32, 3] / 255.0) == pytest.approx(5.2, rel=RGBD)
    write_glb(tmp_path / "dark.glb", dataclasses.replace(shot, radiance=None))
    assert EXTENSION.encode() not in (tmp_path / "dark.glb").read_bytes()
