"""Light that is followed from virtual lights: what paths from the camera find with more noise, and by an integral."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt
import pytest

from tests.kernel_rig import look_at
from tests.test_path_tracer import ABOVE, ERRORS, WHITE, boxes, latlong_sky, polish
from warp_ar.accuracy import path_tracer
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.kernels.receiver.receiver import DEFAULT_REFLECTANCE, PRIOR_WEIGHT
from warp_ar.kernels.reference.path_photons import UNIT
from warp_ar.light.captured import CapturedEmitter, latlong_directions
from warp_ar.light.captured import Light as CapturedLight
from warp_ar.scene import Camera, Light, MetallicRoughnessMaterial, Object, PhongMaterial, Proxy, Scene

pytestmark = pytest.mark.slow

# Dim, so that what virtual lights bring is more than its noise.
SKY = 0.04 * latlong_sky()
FRAME = np.full((32, 48, 3), 0.02, np.float32)
POINT = Light("point", 0.25, at=(0.1, -0.1, 0.35))
SPOT = Light("spot", 0.4, at=(0.1, -0.1, 0.35), target=(0.05, 0.05, 0.0), inner_angle=15.0, outer_angle=35.0)


def lit(*lights: Light, lens: tuple[float, ...] = (0.0,) * 4) -> Scene:
    """``boxes`` with other lights, a lens, plastic instead of what is matt, and rougher metal.

    Of what that throws paths from the camera know their error.
    """
    scene = boxes(True)
    matt, metal = scene.objects
    metal = dataclasses.replace(metal, material=MetallicRoughnessMaterial((1.0, 1.0, 1.0), 1.0, 0.5))
    plastic = dataclasses.replace(matt, material=MetallicRoughnessMaterial((0.9, 0.6, 0.7), 0.0, 0.5))
    camera = dataclasses.replace(scene.camera, distortion=lens)
    return dataclasses.replace(scene, lights=lights, objects=(plastic, metal), camera=camera)


def lamp_above() -> CapturedLight:
    """A dim sky with a lamp that stands 0.5 m from where it was mirrored."""
    height, toward = 64, np.array([0.3, -0.4, 0.866])
    radiance = np.repeat(np.full((height, 2 * height, 1), 0.02, np.float32), 3, axis=2)
    toward = toward / np.linalg.norm(toward)
    radiance[latlong_directions(height) @ toward > math.cos(math.radians(5.0))] = (60.0, 45.0, 30.0)
    x, y, z = (float(value) for value in toward)
    emitter = CapturedEmitter((x, y, z), 0.03, (1.0, 0.8, 0.5), (60.0, 45.0, 30.0), None, 0.5, (0.0, 0.0, 0.03))
    return CapturedLight(radiance, np.ones(radiance.shape[:2], np.float32), (emitter,))


def tracer_of(
    scene: Scene,
    device: str,
    samples: int,
    seed: int,
    monkeypatch: pytest.MonkeyPatch,
    *,
    follows: bool = True,
    sky: CapturedLight | npt.NDArray[np.float32] = SKY,
) -> PathTracer:
    with monkeypatch.context() as patch:
        if not follows:
            patch.setattr(path_tracer, "follows_lights", lambda *given: False)
            patch.setattr(path_tracer, "is_polished_one", lambda *given: False)
        tracer = PathTracer(scene, sky, FRAME, ABOVE, device=device, seed=seed)
        tracer.sample(samples)
        assert (tracer._followed > 0) == follows
        return tracer


def change_of(tracer: PathTracer) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Change of a white surface in every pixel and its standard error: without what the frame's reflectance adds."""
    shape = tracer._moments.change.shape
    change, products = (
        np.array(a.numpy(), np.float64) for a in (tracer._moments.change, tracer._moments.change_change)
    )
    samples = tracer._moments.samples.numpy()[..., None].astype(np.float64)
    variance = products / (samples * (samples - 1.0))
    if tracer._followed:
        image = tracer._image_of_lights
        sums, squares = (a.numpy().reshape(*shape, 3) / float(UNIT) for a in (image.sums, image.squares))
        pixels = shape[0] * shape[1]
        kinds = int(tracer._follows_lights) + int(tracer._follows_emitters)
        paths = tracer._followed * kinds * math.ceil(path_tracer.PATHS_OF_LIGHTS * pixels)
        change += sums * pixels / paths
        # Sums are whole numbers: where one path alone came, rounding may leave less than nothing.
        variance += np.maximum(squares - sums**2 / paths, 0.0) * (pixels / paths) ** 2
    return change, np.sqrt(variance)


CASES = {
    "two, lens": lit(POINT, dataclasses.replace(SPOT, at=(-0.2, 0.0, 0.3)), lens=(-0.2, 0.05, 0.004, -0.006)),
    "polished": polish(lit(POINT), 0.3, 0.4),
}


@pytest.mark.parametrize("name", CASES)
def test_both_ways_have_the_same_mean(name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of pixels, and all of them; what is followed is many times the noise by which they are told apart."""
    followed = tracer_of(CASES[name], device, 192, 1, monkeypatch)
    camera = tracer_of(CASES[name], device, 384, 2, monkeypatch, follows=False)
    (found, error), (expected, other) = change_of(followed), change_of(camera)
    off, noise = found - expected, np.hypot(error, other)
    for i in range(0, 32, 8):
        for j in range(0, 48, 8):
            block = np.s_[i : i + 8, j : j + 8]
            spread = np.sqrt((noise[block] ** 2).sum(axis=(0, 1)))
            assert (np.abs(off[block].sum(axis=(0, 1))) <= ERRORS * spread + 1e-4).all(), (i, j, off[block].sum())
    whole = math.sqrt((noise**2).sum())
    assert abs(off.sum()) <= ERRORS * whole
    brought = (found - np.array(followed._moments.change.numpy(), np.float64)).sum()
    assert brought > 2.0 * ERRORS * whole
    # So does the picture, which sums it up.
    pictures = followed.picture(), camera.picture()
    spread = np.hypot(pictures[0].error, pictures[1].error).astype(np.float64)
    total = float((pictures[0].radiance - pictures[1].radiance).astype(np.float64).sum())
    assert abs(total) <= ERRORS * math.sqrt((spread**2).sum())


def wall(light: bool) -> Scene:
    """A white wall on a plane, and a light before it: its face is at x = 0, 0.2 wide and 0.1 high.

    Its material could have a lobe, so that its light is followed, and has none.
    """
    matt = PhongMaterial((0.8, 0.8, 0.8), (0.0, 0.0, 0.0), 10.0)
    box = Object("box", size=(0.02, 0.2, 0.1), at=(-0.01, 0.0, 0.05), material=matt)
    lights = (Light("point", 1.0, color=(1.0, 0.5, 0.25), at=(0.3, 0.02, 0.05)),) if light else ()
    camera = Camera(24, 18, 120.0, 120.0, 11.5, 8.5)
    return Scene(camera, objects=(box,), proxies=(Proxy("plane", size=(2.0, 2.0)),), lights=lights)


def by_the_wall(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Irradiance of the plane by light that the wall sends on, of intensity 1: midpoints over the wall."""
    count = 200
    wy, wz = np.meshgrid(
        (np.arange(count) + 0.5) / count * 0.2 - 0.1, (np.arange(count) + 0.5) / count * 0.1, indexing="ij"
    )
    to_light = np.stack([0.3 + 0 * wy, 0.02 - wy, 0.05 - wz], -1)
    square = (to_light**2).sum(-1)
    sent = 0.8 / math.pi * to_light[..., 0] / square**1.5  # radiance
    away = np.stack([x[..., None, None] + 0 * wy, y[..., None, None] - wy, -wz + 0 * x[..., None, None]], -1)
    across = (away**2).sum(-1)
    shape = away[..., 0] * -away[..., 2] / across**2
    return np.asarray((sent * shape).sum(axis=(-1, -2)) * (0.2 * 0.1 / count**2))


def test_a_wall_sends_light_on(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a matt wall throws onto the plane, by an integral in float64; the plane is too dark to throw it back."""
    monkeypatch.setattr(path_tracer, "PATHS_OF_LIGHTS", 4.0)
    pose = look_at((0.3, 0.0, 0.5), (0.06, 0.0, 0.0))
    dark = 0.002
    # What the white sky and the frame tell of it: white paint would be 1 there.
    rho = (math.pi * dark + PRIOR_WEIGHT * DEFAULT_REFLECTANCE) / (math.pi + PRIOR_WEIGHT)
    frame = np.full((18, 24, 3), dark, np.float32)
    tracers = [PathTracer(wall(light), WHITE, frame, pose, device=device, seed=3) for light in (True, False)]
    for tracer in tracers:
        tracer.sample(256)
    pictures = [tracer.picture() for tracer in tracers]
    found = (pictures[0].radiance - pictures[1].radiance).astype(np.float64)
    noise = np.hypot(pictures[0].error, pictures[1].error).astype(np.float64)
    u, v = np.meshgrid((np.arange(24) - 11.5) / 120.0, (np.arange(18) - 8.5) / 120.0)
    directions = np.stack([u, v, np.ones_like(u)], -1) @ pose.rotation
    eye = -pose.rotation.T @ pose.translation
    points = eye + directions * (-eye[2] / directions[..., 2])[..., None]
    x, y = points[..., 0], points[..., 1]
    to_light = np.stack([0.3 - x, 0.02 - y, 0.05 + 0 * x], -1)
    straight = to_light[..., 2] / (to_light**2).sum(-1) ** 1.5
    clear = (x > 0.01) & (x < 0.12)  # before the wall, and not under the light
    assert clear.sum() > 200
    color = np.array([1.0, 0.5, 0.25])
    expected = (rho / math.pi) * (straight + by_the_wall(x, y))[..., None] * color
    sent_on = (rho / math.pi) * by_the_wall(x, y)[..., None] * color
    # A pixel is a square of 4 mm: its middle is its mean within a hundredth.
    off = (found - expected)[clear].sum(axis=0)
    assert (np.abs(off) < ERRORS * np.sqrt((noise[clear] ** 2).sum(axis=0)) + 0.01 * expected[clear].sum(axis=0)).all()
    assert (sent_on[clear].sum(axis=0) > 0.25 * expected[clear].sum(axis=0)).all()
    # What is followed alone, on white.
    brought = change_of(tracers[0])[0] - np.array(tracers[0]._moments.change.numpy(), np.float64)
    integral = (by_the_wall(x, y) / math.pi)[clear].sum() * color
    assert brought[clear].sum(axis=0) == pytest.approx(integral, rel=0.02)


def test_near_emitters_have_the_same_mean_both_ways(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a light that is followed as well, on a polished desk.

    By the same seeds, and before samples go where the noise is: what shadows have of noise is the same in both.
    """
    scene, sky = CASES["polished"], lamp_above()
    off, brought = [], []
    for seed in range(12):
        pair = [tracer_of(scene, device, 16, seed, monkeypatch, sky=sky, follows=follows) for follows in (True, False)]
        assert pair[0]._follows_emitters
        assert pair[0]._follows_lights
        changes = [change_of(tracer)[0] for tracer in pair]
        off.append(changes[0] - changes[1])
        brought.append(changes[0] - np.array(pair[0]._moments.change.numpy(), np.float64))
    for values in (np.stack(off)[:, rows] for rows in (slice(0, 16), slice(16, 32), slice(None))):
        sums = values.sum(axis=(1, 2, 3))
        noise = sums.std(ddof=1) / math.sqrt(len(sums))
        assert abs(sums.mean()) <= ERRORS * noise, (sums.mean(), noise)
    assert np.stack(brought).sum(axis=(1, 2, 3)).mean() > 2.0 * ERRORS * noise, noise
