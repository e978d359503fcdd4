"""The environment within a glTF: its faces, its roughness, its harmonics, against sums that are written out here."""

from __future__ import annotations

import dataclasses
import json
import math
import struct

import cv2
import numpy as np
import pytest

from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.output.gltf_environment import EXTENSION, LARGEST, encode_rgbd, irradiance_coefficients, specular_cubes
from warp_ar.output.gltf_file import write_glb
from warp_ar.output.shot import Shot
from warp_ar.scene import Pose, load_scene

CONSTANT = 1e-5  # of weighted means in float64, kept in float32
RGBD = 0.02  # a step of 8 bits in the brightest channel's 2.2th power, and of D's whole steps
MONTE_CARLO = 5.0  # standard errors
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


def test_a_constant_stays_constant() -> None:
    for cube in specular_cubes(np.full((32, 64, 3), 0.7, np.float32)):
        np.testing.assert_allclose(cube, 0.7, rtol=CONSTANT)


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
    assert found == pytest.approx(expected, abs=MONTE_CARLO * error + 0.01 * expected)


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
