"""Scenes on the device: what is where, what it is made of, and screen rectangles that never cut anything off."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import look_at
from tests.twins import visibility as reference
from warp_ar import scene as scenes
from warp_ar.errors import SceneError
from warp_ar.kernels import structs
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.ray_scene import HostScene
from warp_ar.scene.screen_extents import EMPTY, screen_rects

CAMERA = scenes.Camera(width=64, height=48, fx=60.0, fy=62.0, cx=30.5, cy=24.0)
BENT = dataclasses.replace(CAMERA, distortion=(-0.25, 0.08, 0.003, -0.002, 0.0))

OBJECTS = (
    scenes.Object("sphere", radius=0.1, at=(0.1, 0.0, 0.2), scale=2.0),
    scenes.Object("box", size=(0.1, 0.2, 0.3), at=(-0.2, 0.1, 0.0), rotate=(10.0, 20.0, 30.0)),
    scenes.Object("torus", major_radius=0.2, minor_radius=0.05, at=(0.0, 0.3, 0.1), scale=0.5),
)
PROXIES = (
    scenes.Proxy("plane", size=(1.0, 0.8)),
    scenes.Proxy("box", size=(0.2, 0.2, 0.2), at=(0.3, 0.2, 0.1), rotate=(0.0, 0.0, 25.0)),
)

# Records are float32; twins in this file work on float64 numbers.
RECORD_TOLERANCE = 1e-6


def screen_rect(outline, pose, camera):
    """The rectangle of one outline."""
    return screen_rects([outline], pose, camera)[0]


def records(host: HostScene, name: str):
    scene = getattr(host.ray_scene, name)
    return scene.numpy()


def bodies(values) -> list[reference.Body]:
    """Twins of analytic shapes; a mesh stands for the box around it, which is what rectangles are made from."""
    kinds = {structs.PLANE: "plane", structs.BOX: "box", structs.MESH: "box", structs.SPHERE: "sphere"}
    return [
        reference.Body(
            kinds[int(value["kind"])],
            value["rotation"].astype(np.float64),
            value["position"].astype(np.float64),
            float(value["scale"]),
            value["extent"].astype(np.float64),
        )
        for value in values
    ]


def pixel_rays(camera, offset):
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    pixels = np.stack([columns + offset[0], rows + offset[1]], -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.matrix(), np.array(camera.distortion))
    return np.concatenate([rays.reshape(-1, 2), np.ones((rays.shape[0], 1))], -1)


def seen(shapes, pose, camera):
    """Pixels in which some ray, sub-pixel ones included, meets a shape."""
    inverse = pose.inverse()
    mask = np.zeros((camera.height, camera.width), bool)
    for offset in ((0, 0), (-0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (0.5, -0.5)):
        directions = pixel_rays(camera, offset) @ inverse.rotation.T
        origins = np.broadcast_to(inverse.translation, directions.shape)
        mask |= (reference.closest(shapes, origins, directions)[1] >= 0).reshape(mask.shape)
    return mask


# --- What is where ----------------------------------------------------------------------------------------------------


def test_mesh_is_moved_to_its_middle_and_back(device, tmp_path):
    """A mesh far from its own origin stands where the scene says, and keeps its digits."""
    triangle = np.array([[1000.0, 5, 5], [1001, 5, 5], [1000, 6, 7]])
    path = tmp_path / "far.obj"
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in triangle) + "f 1 2 3\n")
    item = scenes.Object("mesh", file=path, rotate=(0.0, 0.0, 90.0), scale=2.0, at=(1.0, 2.0, 3.0))
    host = HostScene(scenes.Scene(CAMERA, objects=(item, item)), wp.get_device(device))
    value = records(host, "objects")[0]
    center = np.array([1000.5, 5.5, 6.0])
    np.testing.assert_allclose(
        value["position"], 2 * np.array([-center[1], center[0], center[2]]) + [1, 2, 3], rtol=1e-6
    )
    np.testing.assert_allclose(value["extent"], [0.5, 0.5, 1.0], rtol=RECORD_TOLERANCE)
    # One file is loaded once, however often it stands in the scene.
    assert records(host, "objects")["mesh"][0] == records(host, "objects")["mesh"][1]
    assert host.ray_scene.vertex_normals.shape == (3,)


def test_motion(device):
    """A turning, swaying object is written where the scene puts it; standing ones change nothing."""
    moving = dataclasses.replace(
        OBJECTS[1], animate=scenes.Animation(turn=(0.0, 0.0, 90.0), pivot=(0.0, 0.0, 0.0), sway=(0.0, 0.0, 0.1))
    )
    lamp = scenes.Light("spot", 2.0, target=(0.0, 0.0, 0.0), at=(0.0, 0.0, 1.0), inner_angle=10.0, outer_angle=20.0)
    lamp = dataclasses.replace(lamp, animate=scenes.Animation(sway=(0.5, 0.0, 0.0)), color=(1.0, 0.5, 0.25))
    host = HostScene(scenes.Scene(CAMERA, objects=(OBJECTS[0], moving), lights=(lamp,)), wp.get_device(device))
    objects = np.zeros(2, np.dtype(structs.Shape.numpy_dtype()))
    lights = np.zeros(1, np.dtype(structs.Light.numpy_dtype()))
    assert host.write_objects(objects, 0.0)
    assert not host.write_objects(objects, 0.0)
    assert host.write_lights(lights, 0.0)
    assert not host.write_lights(lights, 0.0)
    assert host.write_objects(objects, 1.0)
    assert host.write_lights(lights, 1.0)
    np.testing.assert_allclose(objects["position"][0], OBJECTS[0].at)
    np.testing.assert_allclose(objects["position"][1], [-0.1, -0.2, 0.1], atol=RECORD_TOLERANCE)
    np.testing.assert_allclose(objects["rotation"][1], rotation_matrix((10, 20, 120)), atol=RECORD_TOLERANCE)
    np.testing.assert_allclose(lights["position"][0], [0.5, 0, 1], atol=RECORD_TOLERANCE)
    np.testing.assert_allclose(lights["direction"][0], np.array([-0.5, 0, -1]) / math.sqrt(1.25), atol=RECORD_TOLERANCE)
    np.testing.assert_allclose(lights["intensity"][0], [2, 1, 0.5])
    np.testing.assert_allclose(lights["outer_angle"], math.radians(20))


# --- Materials --------------------------------------------------------------------------------------------------------


def test_texture_needs_coordinates(device, tmp_path):
    """A texture on a mesh without texture coordinates names both files."""
    mesh, picture = tmp_path / "plain.ply", tmp_path / "wood.png"
    mesh.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    cv2.imwrite(str(picture), np.zeros((2, 2, 3), np.uint8))
    item = scenes.Object("mesh", file=mesh, material=scenes.LambertMaterial(picture))
    with pytest.raises(
        SceneError, match=r"plain\.ply: the mesh has no texture coordinates for the texture .*wood\.png"
    ):
        HostScene(scenes.Scene(CAMERA, objects=(item,)), wp.get_device(device))


# --- Rectangles -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["pinhole", "bent"])
def test_object_rect_holds_every_ray_that_meets_an_object(device, camera):
    """Cameras all around, near, inside, beside and looking away: nothing is cut off, and little is wasted."""
    host = HostScene(scenes.Scene(camera, objects=OBJECTS), wp.get_device(device))
    shapes = bodies(records(host, "objects"))
    rng = np.random.default_rng(0)
    wasted = []
    for index in range(60):
        distance = (0.05, 0.4, 1.0, 3.0)[index % 4]
        eye = rng.normal(size=3) * distance
        pose = look_at(eye, rng.normal(size=3) * 0.3)
        rect = screen_rect(host.object_outline(), pose, camera)
        mask = seen(shapes, pose, camera)
        inside = np.zeros_like(mask)
        inside[rect[0] : rect[1], rect[2] : rect[3]] = True
        assert not (mask & ~inside).any(), (eye, rect)
        if not inside.any():
            assert rect == EMPTY
        if distance == 3.0 and mask.any():
            rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
            tight = (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
            wasted.append(inside.sum() / tight)
    # Boxes around three small objects, and a pixel on every side.
    assert np.median(wasted) < 3.0


def test_nothing_in_front_gives_no_rectangle(device):
    """Objects behind the camera, and no object at all."""
    host = HostScene(scenes.Scene(CAMERA, objects=OBJECTS), wp.get_device(device))
    assert screen_rect(host.object_outline(), look_at((0.0, -2.0, 0.1), (0.0, -3.0, 0.1)), CAMERA) == EMPTY
    empty = HostScene(scenes.Scene(CAMERA), wp.get_device(device))
    assert screen_rect(empty.object_outline(), look_at((0.0, -2.0, 0.1), (0.0, 0.0, 0.0)), CAMERA) == EMPTY
    assert screen_rect(empty.light_outline(), look_at((0.0, -2.0, 0.1), (0.0, 0.0, 0.0)), CAMERA) == EMPTY


LAMPS = {
    "down": scenes.Light("spot", 1.0, at=(0.1, 0.0, 0.5), target=(0.1, 0.1, 0.0), inner_angle=5.0, outer_angle=12.0),
    "oblique": scenes.Light("spot", 1.0, at=(-0.6, 0, 0.2), target=(0.2, 0.1, 0), inner_angle=5.0, outer_angle=14.0),
    "wide": scenes.Light("spot", 1.0, at=(0, 0, 0.3), direction=(0, 0.3, -1), inner_angle=40.0, outer_angle=89.0),
    "away": scenes.Light("spot", 1.0, at=(0, 0, 0.3), direction=(0, 0, 1), inner_angle=10.0, outer_angle=30.0),
    "inside the box": scenes.Light("spot", 1.0, at=(0.3, 0.2, 0.1), direction=(1, 0, 0), inner_angle=9, outer_angle=20),
    "point": scenes.Light("point", 1.0, at=(0, 0, 0.3)),
}


@pytest.mark.parametrize("name", list(LAMPS))
def test_light_rect_holds_every_lit_pixel(device, name):
    """Every pixel whose point on a proxy lies in the cone is inside; a narrow cone does not take the whole desk."""
    lamp = LAMPS[name]
    host = HostScene(scenes.Scene(CAMERA, lights=(lamp,), proxies=PROXIES), wp.get_device(device))
    shapes = bodies(records(host, "proxies"))
    position, axis = lamp.pose_at(0.0)
    outer = math.pi if lamp.kind == "point" else math.radians(lamp.outer_angle)
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(25):
        pose = look_at([*rng.uniform(-0.9, 0.9, 2), rng.uniform(0.2, 1.0)], [*rng.uniform(-0.2, 0.2, 2), 0.0])
        rect = screen_rect(host.light_outline(), pose, CAMERA)
        inverse = pose.inverse()
        directions = pixel_rays(CAMERA, (0, 0)) @ inverse.rotation.T
        t, which, _ = reference.closest(shapes, np.broadcast_to(inverse.translation, directions.shape), directions)
        points = inverse.translation + np.where(which >= 0, t, 0.0)[:, None] * directions
        arm = points - position
        angle = np.arccos(np.clip(arm @ axis / np.linalg.norm(arm, axis=-1), -1, 1))
        lit = ((which >= 0) & (angle < outer)).reshape(CAMERA.height, CAMERA.width)
        inside = np.zeros_like(lit)
        inside[rect[0] : rect[1], rect[2] : rect[3]] = True
        assert not (lit & ~inside).any(), rect
        shares.append(inside.mean())
    if name == "down":
        assert np.median(shares) < 0.3
    if name == "away":
        assert max(shares) == 0.0


SENDING = {
    "box": PROXIES,
    "wall": (PROXIES[0], scenes.Proxy("plane", size=(1.0, 0.6), at=(0.0, 0.4, 0.3), rotate=(90.0, 0.0, 0.0))),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LAMPS))
@pytest.mark.parametrize("proxies", list(SENDING))
def test_light_rect_holds_every_pixel_that_gets_bounced_light(device, name, proxies):
    """Every pixel's point that lies before some point that the lamp sees, which lies before it, is inside."""
    lamp = LAMPS[name]
    host = HostScene(scenes.Scene(CAMERA, lights=(lamp,), proxies=SENDING[proxies]), wp.get_device(device))
    shapes = bodies(records(host, "proxies"))
    position, axis = lamp.pose_at(0.0)
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    if lamp.kind == "spot":
        directions = axis + 2 * math.tan(math.radians(min(lamp.outer_angle, 80))) * directions
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        directions = directions[directions @ axis > math.cos(math.radians(lamp.outer_angle))]
    t, which, normals = reference.closest(shapes, np.broadcast_to(position, directions.shape), directions)
    lit = (which >= 0) & ((normals * directions).sum(-1) < 0)
    sources, facings = (position + np.where(lit, t, 0)[:, None] * directions)[lit][:400], normals[lit][:400]
    reached = 0
    for _ in range(8):
        pose = look_at([*rng.uniform(-0.9, 0.9, 2), rng.uniform(0.2, 1.0)], [*rng.uniform(-0.2, 0.2, 2), 0.0])
        rect = screen_rect(host.light_outline(bounced=True), pose, CAMERA)
        direct = screen_rect(host.light_outline(), pose, CAMERA)
        inverse = pose.inverse()
        directions = pixel_rays(CAMERA, (0, 0)) @ inverse.rotation.T
        t, which, normals = reference.closest(
            shapes, np.broadcast_to(inverse.translation, directions.shape), directions
        )
        seen = (which >= 0) & ((normals * directions).sum(-1) < 0)
        points = inverse.translation + np.where(seen, t, 0)[:, None] * directions
        # Of the way from each point to each source, along both normals.
        leaves = (facings * sources).sum(-1) - points @ facings.T < -1e-6
        gets = (normals @ sources.T - (points * normals).sum(-1)[:, None] > 1e-6) & leaves
        gets = (gets.any(1) & seen).reshape(CAMERA.height, CAMERA.width)
        inside = np.zeros_like(gets)
        inside[rect[0] : rect[1], rect[2] : rect[3]] = True
        assert not (gets & ~inside).any(), rect
        if direct != EMPTY:
            assert inside[direct[0] : direct[1], direct[2] : direct[3]].all()
        reached += gets.sum()
    assert (reached > 0) == (len(sources) > 0 and name != "inside the box")
