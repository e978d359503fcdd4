"""The path tracer: furnaces, closed forms, differences, honest errors, and another renderer."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.kernel_rig import look_at
from warp_ar.accuracy import path_tracer
from warp_ar.accuracy.path_tracer import PathTracer, TracedPicture
from warp_ar.light.captured import CapturedEmitter, Light, latlong_directions
from warp_ar.scene import (
    Camera,
    LambertMaterial,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    Pose,
    Probe,
    Proxy,
    ProxyMaterial,
    Scene,
)
from warp_ar.scene import Light as VirtualLight

pytestmark = pytest.mark.slow

# Standard errors that a mean may be off; seeds are fixed.
ERRORS = 4.5
# The table of directional albedo is bilinear over 32 x 32: metals in the furnace are right within so much of 1.
TABLE_TOLERANCE = 4e-3
# Float32 sums along one path, where every path gives the same.
ROUNDING = 2e-5
WHITE = np.ones((8, 16, 3), np.float32)
CAMERA = Camera(32, 24, 40.0, 40.0, 15.5, 11.5)


def trace(
    scene: Scene,
    light: Any,
    pose: Pose,
    device: str,
    *,
    frame: npt.NDArray[Any] | None = None,
    samples: int = 32,
    **more: Any,
) -> TracedPicture:
    tracer = PathTracer(scene, light, frame, pose, device=device, **more)
    tracer.sample(samples)
    return tracer.picture()


def check(picture: TracedPicture, expected: Any, where: Any = ..., tolerance: float = ROUNDING) -> None:
    """The mean over pixels within its standard error, and no pixel far off."""
    off = (picture.radiance - expected)[where].astype(np.float64)
    error = picture.error[where].astype(np.float64)
    mean = math.sqrt((error**2).sum()) / error.size
    assert abs(off.mean()) <= ERRORS * mean + tolerance, (off.mean(), mean)
    rare = 0.25 * np.abs(picture.radiance[where]) * (error > 0)  # bright paths that few samples have seen
    assert (np.abs(off) <= 6.0 * error + np.maximum(tolerance, rare)).all()


def ball(material: Any, radius: float = 0.3) -> Scene:
    return Scene(CAMERA, objects=(Object("sphere", radius=radius, material=material),))


@pytest.mark.parametrize(
    "material",
    [
        LambertMaterial((1.0, 1.0, 1.0)),
        MirrorMaterial((1.0, 1.0, 1.0)),
        MetallicRoughnessMaterial((1.0, 1.0, 1.0), 1.0, 0.0),
        MetallicRoughnessMaterial((1.0, 1.0, 1.0), 1.0, 0.5),
        MetallicRoughnessMaterial((1.0, 1.0, 1.0), 1.0, 1.0),
        MetallicRoughnessMaterial((1.0, 1.0, 1.0), 0.0, 0.3),
    ],
    ids=["lambert", "mirror", "smooth metal", "metal", "rough metal", "plastic"],
)
def test_white_is_white_in_a_white_furnace(material: Any, device: str) -> None:
    check(trace(ball(material), WHITE, look_at((1.0, 0.3, 0.4)), device), 1.0, tolerance=TABLE_TOLERANCE)


def test_a_sphere_in_a_gradient(device: str) -> None:
    """L = a + b z gives E(n) / pi = a + 2/3 b n.z, in every pixel."""
    height = 64
    z = np.cos((np.arange(height) + 0.5) * math.pi / height)
    light = np.repeat((1.0 + 0.6 * z)[:, None, None], 2 * height, 1).repeat(3, 2).astype(np.float32)
    scene = ball(LambertMaterial((0.5, 0.25, 1.0)), 0.8)
    pose = look_at((1.5, 0.0, 0.0))
    # So near and so small a picture that the sphere fills it.
    picture = trace(scene, light, pose, device, samples=64, size=(16, 12))
    x, y = np.meshgrid((np.arange(16) - 7.5) / 20.0, (np.arange(12) - 5.5) / 20.0)
    directions = np.stack([x, y, np.ones_like(x)], -1) @ pose.rotation
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    half = 1.5 * -directions[..., 0]
    t = half - np.sqrt(half**2 - (1.5**2 - 0.8**2))
    up = (t * directions[..., 2]) / 0.8
    expected = (1.0 + 0.4 * up)[..., None] * np.array([0.5, 0.25, 1.0])
    # A pixel is as wide as a fifteenth of the sphere's radius; where it is turned away the mean over it differs.
    check(picture, expected, tolerance=3e-3)


def test_light_in_a_closed_sphere(device: str) -> None:
    """An integrating sphere: L = rho E / pi / (1 - rho), E = I / R^2. Many bounces, ended by Russian roulette."""
    rho, radius, intensity = 0.7, 0.5, 0.2
    scene = dataclasses.replace(
        ball(LambertMaterial((rho, rho, rho)), radius), lights=(VirtualLight("point", intensity),)
    )
    picture = trace(scene, 1e3 * WHITE, look_at((0.2, 0.1, 0.1)), device, samples=64)
    check(picture, rho * intensity / radius**2 / math.pi / (1.0 - rho), tolerance=1e-4)


def test_a_light_inside_an_object_stays_there(device: str) -> None:
    """Hard case: nothing of it gets out, whether it is a point or has a disk."""
    for radius in (0.0, 0.02):
        light = VirtualLight("point", 100.0, at=(0, 0, 0.1), radius=radius)
        scene = dataclasses.replace(ball(LambertMaterial((0.5, 0.5, 0.5))), lights=(light,))
        assert not trace(scene, 0.0 * WHITE, look_at((1.0, 0.3, 0.4)), device).radiance.any()


def test_a_disk_is_as_bright_in_a_mirror_as_it_lights(device: str) -> None:
    """A light of a radius, seen in a mirror and on a rough metal: both ways to reach it, balanced, give one answer."""
    intensity, distance, radius = 0.5, 1.0, 0.2
    axis, across = np.array([0.0, math.sqrt(0.5), math.sqrt(0.5)]), np.array([0.0, math.sqrt(0.5), -math.sqrt(0.5)])
    light = VirtualLight("point", intensity, at=tuple(distance * axis), radius=radius)
    pose = look_at((0.0, -0.4, 0.4))
    box = Object("box", size=(0.6, 0.6, 0.2), at=(0.0, 0.0, -0.1), material=MirrorMaterial())
    shown = trace(Scene(CAMERA, objects=(box,), lights=(light,)), 0 * WHITE, pose, device, samples=64)
    # On the disk's axis its radiance is E / (pi r^2 / d^2).
    assert shown.radiance.max() == pytest.approx(intensity / (math.pi * radius**2), rel=0.1)
    means = []
    for roughness in (0.35, 0.8):
        metal = dataclasses.replace(box, material=MetallicRoughnessMaterial((1, 1, 1), 1.0, roughness))
        one = trace(Scene(CAMERA, objects=(metal,), lights=(light,)), 0 * WHITE, pose, device, samples=64)
        # The disk as many points without extent, which only the lights' own draws reach.
        turns = np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False)
        spread = np.sqrt((np.arange(4) + 0.5) / 4) * radius
        right = np.array([1.0, 0.0, 0.0])
        places = [distance * axis + r * (math.cos(a) * right + math.sin(a) * across) for r in spread for a in turns]
        points = tuple(dataclasses.replace(light, at=tuple(at), radius=0.0, intensity=intensity / 48) for at in places)
        many = trace(Scene(CAMERA, objects=(metal,), lights=points), 0 * WHITE, pose, device, samples=16)
        middle = np.s_[8:16, 10:22]
        means.append(one.radiance[middle].mean() / many.radiance[middle].mean())
    # The disk turns toward each point and its far parts are farther: r^2 / d^2 = 4 % of the light at most.
    assert means == pytest.approx([1.0, 1.0], abs=0.04)


def desk(*objects: Object, lights: tuple[VirtualLight, ...] = (), probes: tuple[Probe, ...] = ()) -> Scene:
    plane = Proxy("plane", size=(4.0, 4.0))
    return Scene(CAMERA, proxies=(plane,), objects=objects, lights=lights, probes=probes)


FRAME = np.full((24, 32, 3), (0.3, 0.4, 0.5), np.float32)
DOWN = look_at((0.0, -0.6, 0.6))


def test_without_virtual_things_the_picture_is_the_frame(device: str) -> None:
    """To the bit, with a ball and boxes around; so it is where they are out of sight."""
    rng = np.random.default_rng(1)
    frame = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    scene = desk(probes=(Probe((0.1, 0.1, 0.05), 0.05),))
    picture = trace(scene, WHITE, DOWN, device, frame=frame, samples=8)
    np.testing.assert_array_equal(picture.image, frame)
    assert not picture.error.any()


def test_virtual_light_on_what_the_frame_shows(device: str) -> None:
    """Reflectance is the frame over the light that it had: a white sky of radiance 1 makes it the frame itself."""
    light = VirtualLight("directional", 0.9, direction=(0.0, 0.6, -0.8))
    picture = trace(desk(lights=(light,)), WHITE, DOWN, device, frame=FRAME, samples=64)
    # The prior of a dark environment adds half of a thousandth.
    check(picture, FRAME * (1.0 + 0.9 * 0.8 / math.pi), tolerance=2e-3)


def test_the_shadow_of_a_black_sphere(device: str) -> None:
    """Above the sphere's foot (r / h)^2 of a white sky's irradiance is gone, whatever the receiver is painted."""
    radius, height = 0.1, 0.3
    sphere = Object("sphere", radius=radius, at=(0.0, 0.0, height), material=LambertMaterial((0.0, 0.0, 0.0)))
    scene = dataclasses.replace(desk(sphere), camera=Camera(8, 6, 400.0, 400.0, 3.5, 2.5))
    picture = trace(scene, WHITE, look_at((0.0, -0.6, 0.2)), device, frame=FRAME[:6, :8], samples=256)
    check(picture, FRAME[:6, :8] * (1.0 - (radius / height) ** 2), tolerance=2e-3)


def test_a_white_sphere_shades_nothing_in_a_white_furnace(device: str) -> None:
    """On a white receiver: what the sphere hides it sends itself, by any number of bounces between the two."""
    frame = np.full((24, 32, 3), 0.999, np.float32)
    sphere = Object("sphere", radius=0.1, at=(0.0, 0.0, 0.1), material=LambertMaterial((1.0, 1.0, 1.0)))
    scene = desk(sphere, probes=(Probe((0.2, 0.1, 0.08), 0.08, (1.0, 1.0, 1.0)),))
    # A plane of finite size, and reflectance 0.999: a few thousandths.
    check(trace(scene, WHITE, DOWN, device, frame=frame, samples=128), 0.999, tolerance=4e-3)


def test_emitters_light_from_where_they_are(device: str) -> None:
    """What a frame lit by a lamp at a known distance was made of is found at every place, not only below the ball."""
    height, distance = 64, 0.7
    radiance = np.full((height, 2 * height, 3), 0.1, np.float32)
    theta = (np.arange(height) + 0.5)[:, None] * math.pi / height
    radiance[np.broadcast_to(theta < 0.06, radiance.shape[:2])] = 200.0
    emitter = CapturedEmitter((0.0, 0.0, 1.0), 0.01, (1.0,) * 3, (1.0,) * 3, None, distance, (0.0, 0.0, 0.0))
    light = Light(radiance, np.ones(radiance.shape[:2], np.float32), (emitter,))
    plane = Scene(CAMERA, proxies=(Proxy("plane", size=(4.0, 4.0)),))
    whole = trace(plane, light, DOWN, device, samples=64, reflectances=((0.5, 0.25, 1.0),))
    power = float((radiance[..., 0] - 0.1).max()) * 2.0 * math.pi * (1.0 - math.cos(math.pi / height))
    x, y = np.meshgrid((np.arange(32) - 15.5) / 40.0, (np.arange(24) - 11.5) / 40.0)
    directions = np.stack([x, y, np.ones_like(x)], -1) @ DOWN.rotation
    at = np.array([0.0, -0.6, 0.6]) - 0.6 * directions / directions[..., 2:]
    away = np.array([0.0, 0.0, distance]) - at
    square = (away**2).sum(-1)
    irradiance = power * distance**2 / square * away[..., 2] / np.sqrt(square) + 0.1 * math.pi
    expected = irradiance[..., None] / math.pi * np.array([0.5, 0.25, 1.0])
    assert expected.max() > 1.5 * expected.min()
    # The frame: the lamp has a size, pixels have one, and the sky ends at the plane's edge.
    check(whole, expected, np.s_[2:-2, 2:-2], tolerance=0.02 * float(expected.mean()))


def boxes(virtual: bool) -> Scene:
    """A desk with a box, a ball, and if ``virtual`` two spheres and a light without much of a size."""
    return Scene(
        Camera(48, 32, 55.0, 55.0, 23.5, 15.5),
        probes=(Probe((-0.12, 0.03, 0.035), 0.035, (0.85, 0.85, 0.87)),),
        proxies=(
            Proxy("plane", size=(1.2, 1.0)),
            Proxy("box", at=(0.02, 0.2, 0.05), rotate=(0.0, 0.0, 8.0), size=(0.24, 0.08, 0.1)),
        ),
        objects=(
            Object("sphere", radius=0.04, at=(0.08, 0.0, 0.04), material=LambertMaterial((0.7, 0.2, 0.3))),
            Object(
                "sphere", radius=0.03, at=(-0.02, -0.06, 0.03), material=MetallicRoughnessMaterial((1, 1, 1), 1.0, 0.2)
            ),
        )
        if virtual
        else (),
        lights=(VirtualLight("point", 0.05, at=(0.1, -0.1, 0.35), radius=0.004),) if virtual else (),
    )


RHO = ((0.4, 0.3, 0.2), (0.2, 0.5, 0.6))
"""Reflectance of the plane and the box of ``boxes``."""
ABOVE = look_at((0.1, -0.5, 0.35))


def sky(directions: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """A smooth environment with a broad sun."""
    sun = np.array([0.3, -0.5, 0.81])
    glow = np.exp(20.0 * (directions @ (sun / np.linalg.norm(sun)) - 1.0))[..., None]
    base = (0.6 + 0.3 * directions[..., 2] + 0.2 * directions[..., 0])[..., None]
    return (base * np.array([1.0, 1.0, 1.2]) + glow * np.array([6.0, 5.0, 4.0])).astype(np.float32)


def latlong_sky(height: int = 64) -> npt.NDArray[np.float32]:
    return sky(latlong_directions(height))


def test_standard_errors_are_honest(device: str) -> None:
    """The spread over seeds is what each picture says of itself."""
    light = latlong_sky()
    frame = trace(boxes(False), light, ABOVE, device, reflectances=RHO, samples=64).radiance
    pictures = [trace(boxes(True), light, ABOVE, device, frame=frame, samples=12, seed=seed) for seed in range(10, 30)]
    radiance = np.stack([p.radiance for p in pictures]).astype(np.float64)
    claimed = (np.stack([p.error for p in pictures]).astype(np.float64) ** 2).mean(0)
    found = radiance.var(axis=0, ddof=1)
    # Rare bright paths say little in 12 samples: the median over pixels that have noise is asked for.
    noisy = claimed > 1e-8
    assert noisy.mean() > 0.3
    assert np.median(found[noisy] / claimed[noisy]) == pytest.approx(1.0, abs=0.15)
    common = claimed < np.quantile(claimed[noisy], 0.95)
    assert found[common].sum() / claimed[common].sum() == pytest.approx(1.0, abs=0.2)


def test_uneven_samples_are_no_bias(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Means over blocks and seeds, where pixels got their shares from 4 samples on, are those of even samples."""
    light = latlong_sky()
    frame = trace(boxes(False), light, ABOVE, device, reflectances=RHO, samples=64).radiance
    found = {}
    for first, seeds in ((1 << 20, range(12)), (4, range(20, 32))):
        monkeypatch.setattr(path_tracer, "FIRST_ROUND", first)
        pictures = [trace(boxes(True), light, ABOVE, device, frame=frame, samples=32, seed=seed) for seed in seeds]
        found[first] = np.stack([p.radiance for p in pictures]).astype(np.float64).reshape(12, 4, 8, 6, 8, 3)
    blocks = {first: radiance.mean(axis=(2, 4)) for first, radiance in found.items()}
    spread = sum(values.var(axis=0, ddof=1) / 12 for values in blocks.values())
    off = blocks[4].mean(axis=0) - blocks[1 << 20].mean(axis=0)
    assert (np.abs(off) <= ERRORS * np.sqrt(spread) + 1e-6).all(), off / np.sqrt(spread)
    everywhere = off.mean() / np.sqrt(spread.mean() / spread.size)
    assert abs(everywhere) < ERRORS


def test_a_difference_to_a_frame_is_the_whole_scene(device: str) -> None:
    """With a frame of the scene without virtual objects, reflectance is found, and the picture is that with them."""
    light = latlong_sky()
    frame = trace(boxes(False), light, ABOVE, device, reflectances=RHO, samples=512)
    whole = trace(boxes(True), light, ABOVE, device, reflectances=RHO, samples=256, seed=1)
    tracer = PathTracer(boxes(True), light, frame.radiance, ABOVE, device=device, seed=2)
    tracer.sample(128)
    picture = tracer.picture()
    off = picture.radiance - whole.radiance
    error = np.sqrt(picture.error**2 + whole.error**2 + frame.error**2)
    for rows in (slice(0, 16), slice(16, 32)):
        for columns in (slice(0, 16), slice(16, 32), slice(32, 48)):
            block = off[rows, columns].mean(axis=(0, 1))
            noise = np.sqrt((error[rows, columns] ** 2).sum(axis=(0, 1))) / 256
            # Where a pixel shows two surfaces, or the frame is read between its pixels, it is a mean.
            assert (np.abs(block) <= ERRORS * noise + 4e-3).all(), (rows, columns, block, noise)


# --- Polished receivers -----------------------------------------------------------------------------------------------


def gloss_albedo(reflectance: float, roughness: float, cosine: float) -> float:
    """Share of a white sky that a GGX lobe sends to a viewer, in float64: midpoints over the hemisphere."""
    alpha = roughness**2
    count = 1200
    z, phi = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count * 2.0 * math.pi)
    sine = np.sqrt(1.0 - z**2)
    wi = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], -1)
    wo = np.array([math.sqrt(1.0 - cosine**2), 0.0, cosine])
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    spread = alpha**2 / (math.pi * (half[..., 2] ** 2 * (alpha**2 - 1.0) + 1.0) ** 2)
    shadowing = (
        2.0
        * z
        * cosine
        / (
            cosine * np.sqrt(alpha**2 + (1.0 - alpha**2) * z**2)
            + z * math.sqrt(alpha**2 + (1.0 - alpha**2) * cosine**2)
        )
    )
    fresnel = reflectance + (1.0 - reflectance) * (1.0 - half @ wo) ** 5
    return float((spread * shadowing * fresnel / (4.0 * z * cosine) * z).mean() * 2.0 * math.pi)


def polish(scene: Scene, roughness: float, reflectance: float) -> Scene:
    """A scene whose first proxy is polished."""
    material = ProxyMaterial(roughness, (reflectance,) * 3)
    return dataclasses.replace(
        scene, proxies=(dataclasses.replace(scene.proxies[0], material=material), *scene.proxies[1:])
    )


@pytest.mark.parametrize(("roughness", "reflectance"), [(0.3, 0.2), (0.6, 1.0)])
def test_a_polished_receiver_in_a_white_furnace(roughness: float, reflectance: float, device: str) -> None:
    """It sends what it scatters and what its lobe sends, by an integral in float64."""
    scene = dataclasses.replace(polish(desk(), roughness, reflectance), camera=Camera(8, 6, 400.0, 400.0, 3.5, 2.5))
    picture = trace(scene, WHITE, DOWN, device, samples=512, reflectances=((0.3,) * 3,))
    check(picture, 0.3 + gloss_albedo(reflectance, roughness, math.sqrt(0.5)), tolerance=1e-3)


def test_what_is_not_a_number_stays_out(device: str) -> None:
    """Hard cases: an environment of the wild, grazing views, a light on a surface, a camera in a plane."""
    light = latlong_sky()
    light[3, 5], light[10, 7], light[20, 9] = np.nan, -3.0, np.inf
    lamp = VirtualLight("point", 0.1, at=(0.0, 0.0, 0.0))
    sphere = Object("sphere", radius=0.05, at=(0.0, 0.0, 0.05), material=MetallicRoughnessMaterial((1, 1, 1), 0.5, 0.0))
    for height in (0.0, 1e-4, 0.3):
        pose = look_at((0.0, -0.6, height), (0.0, 0.0, height))
        picture = trace(desk(sphere, lights=(lamp,)), light, pose, device, frame=FRAME, samples=8)
        assert np.isfinite(picture.radiance).all()
        assert np.isfinite(picture.error).all()
        assert (picture.radiance >= 0.0).all()


def test_the_same_seed_gives_the_same_bits(device: str) -> None:
    """However many samples are added at a time; another seed gives others."""
    frame = np.full((32, 48, 3), 0.5, np.float32)
    images = []
    # Pixels get their shares anew after 16 samples, and after 32.
    for seed, counts in ((3, (40,)), (3, (3, 13, 5, 19)), (4, (40,))):
        tracer = PathTracer(boxes(True), latlong_sky(), frame, ABOVE, device=device, seed=seed)
        for count in counts:
            tracer.sample(count)
        images.append(tracer.picture())
    np.testing.assert_array_equal(images[0].radiance, images[1].radiance)
    np.testing.assert_array_equal(images[0].error, images[1].error)
    assert (images[0].radiance != images[2].radiance).any()
