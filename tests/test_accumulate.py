import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import records
from tests.twins import accumulate as reference
from warp_ar.kernels.environment import accumulate
from warp_ar.kernels.structs import FrameParams, make_environment_view

# Float32 sums and exponentials, over the levels of a pyramid or over a hundred frames.
SUMS = 2e-5


class Light:
    """The accumulation's arrays, and a frame after another into them."""

    def __init__(self, height=16, width=32):
        self.radiance, self.clipped = (wp.zeros((height, width), dtype=wp.vec3) for _ in range(2))
        self.confidence = wp.zeros((height, width), dtype=wp.float32)
        self.change = wp.zeros(accumulate.change_shape(height, width), dtype=wp.vec2)
        self.shape = (height, width)

    def step(self, radiance, confidence=1.0, clipped=0.0, time_step=1 / 30, reset=0):
        params = records(FrameParams, {"time_step": time_step, "environment_reset": reset})
        h, w = self.shape
        x = wp.array(np.ascontiguousarray(np.broadcast_to(np.float32(radiance), (h, w, 3))), dtype=wp.vec3)
        c = wp.array(np.ascontiguousarray(np.broadcast_to(np.float32(confidence), (h, w))), dtype=wp.float32)
        s = wp.array(np.ascontiguousarray(np.broadcast_to(np.float32(clipped), (h, w, 3))), dtype=wp.vec3)
        view = make_environment_view(x, c, s)
        environment = make_environment_view(self.radiance, self.confidence, self.clipped)
        accumulate.measure_change(view, environment, self.change)
        accumulate.accumulate_environment(view, self.change, params, environment)
        return self.radiance.numpy()


def test_accumulation_matches_twin(device):
    """Noise, a moving mask, a jump in part of the map, uneven frame times."""
    rng = np.random.default_rng(1)
    light, twin = Light(24, 48), reference.Accumulator(24, 48)
    base = rng.uniform(0.1, 1, (24, 48, 3))
    for frame in range(60):
        x = base * rng.normal(1, 0.05, base.shape)
        x[:, 20:30] *= 1.0 if frame < 30 else 2.5
        c = rng.uniform(0, 1, (24, 48)) * (rng.random((24, 48)) > 0.3)
        x, c = np.float32(x), np.float32(c)
        share, dt = np.float32(rng.random(x.shape)), float(rng.uniform(0.01, 0.1))
        light.step(x, c, share, dt)
        twin.step(x.astype(float), c.astype(float), share.astype(float), dt)
    np.testing.assert_allclose(light.radiance.numpy(), twin.environment, atol=SUMS)
    np.testing.assert_allclose(light.confidence.numpy(), twin.confidence, atol=SUMS)
    np.testing.assert_allclose(light.clipped.numpy(), twin.clipped, atol=SUMS)
    check_error("accumulate", light.radiance.numpy(), twin.environment)


@pytest.mark.parametrize("share", [0.0, 0.95, 1.0])
def test_what_clips_below_what_is_known_matches_twin(device, share):
    """A frame that shows much, and frames of a higher exposure, which clip at less."""
    rng = np.random.default_rng(2)
    light, twin = Light(24, 48), reference.Accumulator(24, 48)
    for frame in range(6):
        x = np.float32(rng.uniform(0.9, 1.0, (24, 48, 3)) * (1.0 if frame else 1.5))
        clipped = np.full(x.shape, share if frame else 0.2, np.float32)
        light.step(x, 1.0, clipped, 0.05)
        twin.step(x.astype(float), np.ones(x.shape[:2]), clipped.astype(float), 0.05)
    np.testing.assert_allclose(light.radiance.numpy(), twin.environment, atol=SUMS)
    np.testing.assert_allclose(light.clipped.numpy(), twin.clipped, atol=SUMS)


@pytest.mark.parametrize("fps", [12, 30, 120])
@pytest.mark.parametrize(("old", "new"), [(0.2, 0.9), (0.9, 0.2), (0.5, 0.51), (1.0, 0.0), (0.0, 1.0)])
def test_follows_the_environment_within_half_a_second(device, fps, old, new):
    light = Light()
    for _ in range(5):
        light.step(old, time_step=1 / fps)
    for _ in range(int(np.ceil(0.5 * fps))):
        now = light.step(new, time_step=1 / fps)
    assert np.abs(now - new).max() <= 0.05 * abs(new - old)


def test_noise_is_averaged_and_jitter_is_no_change(device):
    """A sharp edge that jumps a texel to and fro, with sensor noise: steadier by more than half, and right on
    average."""
    rng = np.random.default_rng(3)
    light = Light(32, 64)
    kept = []
    for frame in range(200):
        x = np.full((32, 64, 3), 0.2)
        x[:, 24 + frame % 2 : 40] = 0.9
        x += rng.normal(0, 0.02, x.shape)
        now = light.step(x)
        if frame >= 50:
            kept.append(now.copy())
    kept = np.array(kept)
    assert kept[:, :, 30].std(0).mean() < 0.01
    assert kept[:, :, 24].std(0).mean() < 0.3 * 0.35
    assert kept[:, :, 24].mean() == pytest.approx(0.55, abs=0.02)


def test_what_is_out_of_sight_is_remembered_less_and_less(device):
    light = Light()
    light.step(0.4)
    for _ in range(300):
        now = light.step(0.9, 0.0)
    assert (now == np.float32(0.4)).all()
    np.testing.assert_allclose(light.confidence.numpy(), np.exp(-10 / 20), rtol=1e-4)


def test_reset_forgets(device):
    light = Light()
    light.step(0.4)
    now = light.step(0.9, np.where(np.arange(32) < 16, 1.0, 0.0)[None], reset=1)
    assert (now[:, :16] == np.float32(0.9)).all()
    assert (now[:, 16:] == 0).all()
    assert (light.confidence.numpy()[:, 16:] == 0).all()
