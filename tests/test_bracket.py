"""Alternating exposures: true light from what each of them shows unclipped, and a picture that does not flicker."""

from __future__ import annotations

import dataclasses
import itertools
import json

import cv2
import imageio.v3
import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.photo_files import encode_srgb
from tests.twins import bracket as reference
from tests.twins import latlong as latlong_reference
from tests.twins import unwrap as probe_reference
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.environment import bracket
from warp_ar.kernels.structs import make_environment_view
from warp_ar.scene import Camera, Marker, MirrorMaterial, Object, Pose, PoseSpec, Probe, Proxy, Scene
from warp_ar.session import Session
from warp_ar.sources.exposures import MOST_EXPOSURES, find_exposure, plan_bracket
from warp_ar.sources.synthetic import Synthetic
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

TWIN = 2e-6
"""Float32 weights and means: a dozen roundings."""
ENVIRONMENT = 0.01
"""Irradiance of the rendered environment, relative: codes of 8 bits, and lamps spread over texels of 2.8 degrees;
measured 0.0052."""
ENVIRONMENT_TRACKED = 0.03
"""The same with poses that put the ball a third of a pixel off; measured 0.020."""
CLIPPED_LOSES = 0.7
"""What the longest exposure alone loses there at the least; measured 0.86."""
RATIOS = (1.0, 1.0 / 16.0, 1.0 / 256.0)
CENTER, RADIUS, REFLECTANCE = (-0.1, 0.03, 0.035), 0.035, (0.85, 0.8, 0.9)
SIZE = (320, 240)


def merge(ratios, radiance, confidence, clipped, *, trust=None, rows=None, reach=bracket.REACH):
    """All three outputs of the launchers."""
    count, height, width, _ = radiance.shape
    values = np.zeros(count, np.dtype(bracket.BracketExposure.numpy_dtype()))
    values["ratio"], values["trust"] = ratios, np.ones(count) if trust is None else trust
    exposures = wp.array(values, dtype=bracket.BracketExposure)
    radiance, clipped = (wp.array(np.float32(x), dtype=wp.vec3) for x in (radiance, clipped))
    confidence = wp.array(np.float32(confidence), dtype=wp.float32)
    spread = wp.zeros(clipped.shape, dtype=wp.vec3)
    stack = bracket.ExposureStack()
    stack.radiance, stack.confidence, stack.clipped, stack.spread = radiance, confidence, clipped, spread
    light, share = (wp.full((height, width), wp.vec3(-1.0), dtype=wp.vec3) for _ in range(2))
    out = make_environment_view(light, wp.full((height, width), -1.0, dtype=wp.float32), share)
    for band in rows or [None]:
        bracket.spread_clipping(reach, stack, rows=band)
    for band in rows or [None]:
        bracket.merge_exposures(exposures, stack, reach, out, rows=band)
    return out.radiance.numpy(), out.confidence.numpy(), out.clipped.numpy()


def expose(light, ratios=RATIOS):
    """What every exposure would tell of a map: radiance in its own values, and the share at clipping."""
    exact = np.stack([light * ratio for ratio in ratios])
    return np.minimum(exact, 1.0), (exact >= 1.0).astype(float)


def test_equal_exposures_stay_equal(device):
    """An environment that no exposure clips: every one says the same, and so does their mean."""
    ratios = (1.0, 0.25, 0.0625)  # powers of two, exact
    light = np.full((8, 16, 3), 0.625)
    values, clipped = expose(light, ratios)
    rng = np.random.default_rng(1)
    merged, confidence, share = merge(ratios, values, rng.uniform(0.1, 1.0, (3, 8, 16)), clipped)
    assert (merged == np.float32(0.625)).all()
    assert (share == 0).all()
    assert (confidence > 0).all()


def test_what_clips_comes_from_a_shorter_exposure(device):
    light = np.full((16, 32, 3), 0.2)
    light[5, 9] = (7.0, 100.0, 0.9)
    light[5, 31] = 3.0  # its neighbour lies beyond the seam
    values, clipped = expose(light)
    merged, _, share = merge(RATIOS, values, np.ones((3, 16, 32)), clipped)
    assert np.allclose(merged, light, rtol=1e-6)
    assert (share == 0).all()


@pytest.mark.parametrize("turn", [0, 32, 33])
def test_around_a_lamp_one_exposure_has_the_say(device, turn):
    """The short exposure shows the lamp a texel beside the place where the long one clips: its energy is kept.

    In the middle of the map, and where the lamp lies on the seam or one of the two ends beside it.
    """
    light = np.full((32, 64, 3), 0.1)
    beside = light.copy()
    light[16, 30:32], beside[16, 31:33] = 60.0, 60.0
    light, beside = np.roll(light, turn, axis=1), np.roll(beside, turn, axis=1)
    values, clipped = expose(light)
    moved, moved_clipped = expose(beside)
    values[1:], clipped[1:] = moved[1:], moved_clipped[1:]
    merged, _, _ = merge(RATIOS, values, np.ones((3, 32, 64)), clipped, reach=np.pi / 32)
    assert merged[16].sum() == pytest.approx(light[16].sum(), rel=0.02)  # but for the bound of 1 where it clips
    alone, _, _ = merge(RATIOS, values, np.ones((3, 32, 64)), clipped, reach=0.0)
    assert alone[16].sum() < 0.7 * light[16].sum()  # without its surroundings half of the lamp would be lost


def test_where_all_clip_the_shortest_stands_and_says_so(device):
    light = np.full((8, 16, 3), 1e4)
    values, clipped = expose(light)
    merged, _, share = merge(RATIOS, values, np.ones((3, 8, 16)), clipped)
    assert np.allclose(merged, 256.0)
    assert (share == 1).all()
    merged, _, share = merge(RATIOS, values, np.ones((3, 8, 16)), clipped, trust=[1, 1, 0])
    assert np.allclose(merged, 16.0)  # no frame of the shortest lately


def bad_maps(rng):
    """Every kind of value that unwrapping could ever give."""
    radiance = rng.uniform(0, 1, (3, 12, 24, 3))
    confidence = rng.uniform(0, 1, (3, 12, 24))
    clipped = np.where(rng.uniform(size=(3, 12, 24, 3)) < 0.05, rng.uniform(size=(3, 12, 24, 3)), 0.0)
    radiance[0, 2, 3], radiance[1, 4, 5], radiance[2, 6, 7] = np.nan, np.inf, -1.0
    radiance[:, 11, 23], radiance[:, 0, 0] = 1e6, 0.0
    confidence[0, 8, 9], confidence[:, 10, 11], confidence[1, 1, 1] = np.nan, 0.0, np.nan
    clipped[1, 3, 3] = np.nan
    return radiance, confidence, clipped


def test_twin(device):
    radiance, confidence, clipped = bad_maps(np.random.default_rng(2))
    merged, certainty, share = merge(RATIOS, radiance, confidence, clipped)
    assert np.isfinite(merged).all()
    assert (merged >= 0).all()
    spread = reference.spread_clipping(confidence, clipped, bracket.REACH)
    expected = reference.merge_exposures(RATIOS, radiance, confidence, clipped, spread, bracket.REACH)
    assert np.allclose(merged, expected[0], rtol=TWIN, atol=TWIN)
    assert np.allclose(certainty, expected[1], rtol=TWIN)
    assert np.allclose(share, expected[2], rtol=TWIN)
    for got, want in zip((merged, certainty, share), expected, strict=True):
        check_error("bracket", got, want)


# ---- an environment with lamps far above clipping ----


def environment_light(d):
    """A dim environment, a window, and three lamps of 30 to 240 times what the long exposure can show."""
    light = 0.15 + 0.1 * d[..., 2:] * np.array([1.0, 0.8, 0.6])
    light = light + 2.5 * (np.abs(d - np.array([0.8, -0.1, 0.6])).max(-1, keepdims=True) < 0.25)
    for toward, cosine, power in (((0.5, -0.5, 0.7), 0.99, 30.0), ((-0.6, -0.3, 0.74), 0.995, 120.0)):
        toward = np.array(toward) / np.linalg.norm(toward)
        light = light + power * (d @ toward > cosine)[..., None] * np.array([1.0, 0.9, 0.7])
    sun = np.array([0.1, -0.6, 0.8]) / np.linalg.norm([0.1, -0.6, 0.8])
    return light + 240.0 * (d @ sun > 0.998)[..., None]


def view(index):
    """A camera that moves a little from frame to frame."""
    angle = 0.02 * index
    position = np.array(CENTER) + np.array([0.45 * np.sin(angle), -0.45 * np.cos(angle), 0.3])
    return probe_reference.View(position, np.array(CENTER), size=SIZE, focal=520.0)


def make_scene(**changes):
    camera = view(0)
    scene = Scene(
        camera=Camera(*SIZE, camera.focal, camera.focal, *camera.principal),
        marker=Marker(size=0.08),
        probes=(Probe(CENTER, RADIUS, REFLECTANCE),),
        proxies=(Proxy("plane", size=(1.0, 1.0)),),
        objects=(Object("sphere", radius=0.02, at=(0.02, 0.0, 0.02), material=MirrorMaterial((0.9, 0.9, 0.9))),),
    )
    return dataclasses.replace(scene, **changes)


def pose_of(camera):
    rotation = camera.rotation.T
    return Pose(rotation, -rotation @ camera.position)


def frames(count=9):
    """(picture, pose as tracking would give it, exposure) of a bracket that goes round; the pose errs a little."""
    rng = np.random.default_rng(4)
    pictures = []
    for index in range(count):
        camera, ratio = view(index), RATIOS[index % len(RATIOS)]
        linear = probe_reference.render(
            camera, [(CENTER, RADIUS, REFLECTANCE)], environment_light, lambda d: 0.1 + 0 * d
        )
        linear = np.clip(linear * ratio, 0, 1)
        codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
        noisy = codes + rng.uniform(-0.5, 0.5, codes.shape)
        moved = pose_of(camera)
        shift = rng.normal(0, 0.33 / 520.0 * 0.54, 2)  # a third of a pixel at the ball
        pose = Pose(moved.rotation, moved.translation + np.array([*shift, 0.0]))
        pictures.append((np.clip(np.rint(noisy), 0, 255).astype(np.uint8), pose, 0.02 * ratio))
    return pictures


@pytest.fixture(scope="module")
def clip():
    return frames()


def irradiance(light, rows=None):
    """On 200 directions all around; of a band of the map's rows, all if left out."""
    height, width = light.shape[:2]
    rows = np.arange(height) if rows is None else rows
    at = np.meshgrid(rows + 0.5, np.arange(width) + 0.5, indexing="ij")
    toward = latlong_reference.directions(height, width, *at).reshape(-1, 3)
    normals = np.random.default_rng(0).normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weight = latlong_reference.solid_angles(height, width)[rows].reshape(-1, 1)
    return np.maximum(normals @ toward.T, 0.0) @ (weight * light[rows].reshape(-1, 3))


def true_irradiance():
    height = 256
    rows, columns = np.meshgrid(np.arange(height) + 0.5, np.arange(2 * height) + 0.5, indexing="ij")
    light = environment_light(latlong_reference.directions(height, 2 * height, rows, columns))
    # Band by band: cosines of all texels with all directions at once are gigabytes.
    return sum(irradiance(light, band) for band in np.split(np.arange(height), 8))


def captured(clip, device, exposures, quality, lit=3):
    """The environment after the clip has been played ``lit`` times."""
    with Pipeline(make_scene(), device=device, quality=quality, outputs=("environment",), exposures=exposures) as pipe:
        for index, (image, pose, seconds) in enumerate(clip * lit):
            result = pipe(image, time_seconds=index / 30, pose=pose, exposure_time=seconds)
        return np.array(result.environment, np.float64)


def test_lamps_far_above_clipping_give_their_whole_light(clip, device):
    truth = true_irradiance()
    exposures = [seconds for _, _, seconds in clip]
    quality = PRESETS["medium"]
    exact = [(image, pose_of(view(index)), seconds) for index, (image, _, seconds) in enumerate(clip)]

    def error(light):
        return np.linalg.norm(irradiance(light) - truth) / np.linalg.norm(truth)

    assert error(captured(exact, device, exposures, quality)) < ENVIRONMENT
    assert error(captured(clip, device, exposures, quality)) < ENVIRONMENT_TRACKED
    assert error(captured(exact[:1], device, (), quality.with_methods(recover="clipped"))) > CLIPPED_LOSES


# ---- what is shown ----


def test_a_stream_that_begins_with_a_short_exposure_is_not_dark(clip, device):
    with Pipeline(make_scene(), device=device, quality="low", exposures=(0.02, 0.02 / 16)) as pipe:
        image, pose, seconds = clip[1]
        first = pipe(image, pose=pose, exposure_time=seconds)
        assert not first.shown
        assert abs(first.image.mean() - clip[0][0].mean()) < 8  # codes; coarse steps of a sixteenth of the light


def test_old_frames_of_other_exposures_are_forgotten(clip, device):
    """After some seconds without a short frame the light is what the long one shows."""
    exposures = [seconds for _, _, seconds in clip]
    with Pipeline(make_scene(), device=device, quality="low", outputs=("environment",), exposures=exposures) as pipe:
        for index, (image, pose, seconds) in enumerate(clip):
            pipe(image, time_seconds=index / 30, pose=pose, exposure_time=seconds)
        before = pipe.arrays["merged_radiance"].numpy().max()
        image, pose, _ = clip[0]
        pipe(image, time_seconds=60.0, pose=pose)
        assert before > 100.0
        assert pipe.arrays["merged_radiance"].numpy().max() < 1.5  # 1 over the ball's reflectance


def test_a_folder_of_alternating_exposures(tmp_path, device):
    """By way of the sidecar: marker found in every frame, every second picture repeats the one before."""
    table = decode_table("srgb")[:, 0]
    with Synthetic("card", size=SIZE) as card:
        matrix = card.camera_matrix
        for frame, ratio in zip(card, itertools.cycle((1.0, 1 / 16)), strict=False):
            if frame.index == 6:
                break
            dark = np.searchsorted(0.5 * (table[1:] + table[:-1]), table[frame.image] * ratio)
            imageio.v3.imwrite(tmp_path / f"{frame.index:04d}.png", dark.astype(np.uint8))
    (tmp_path / "exposures.json").write_text(json.dumps([0.016, 0.001]))
    camera = Camera(*SIZE, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    scene = make_scene(camera=camera)
    with Session(scene, source=tmp_path, device=device, quality="low") as session:
        pairs = [(frame, result, np.array(result.image)) for frame, result in session]
    assert all(result.pose is not None and result.state.value == "tracked" for _, result, _ in pairs)
    assert [result.shown for _, result, _ in pairs] == [True, False] * 3
    for (_, _, long), (_, _, short) in zip(pairs[::2], pairs[1::2], strict=True):
        np.testing.assert_array_equal(long, short)


def test_a_folder_of_16_bits_is_merged_in_16_bits(tmp_path, device):
    """Exposures so short that 8 bits round the light away."""
    found, dark = {}, 1 / 64
    with Synthetic("card", size=SIZE) as card:
        matrix = card.camera_matrix
        pictures = [frame.image for frame, _ in zip(card, range(4), strict=False)]
    camera = Camera(*SIZE, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    poses = None
    for bits in (0, 8, 16):
        folder = tmp_path / str(bits)
        folder.mkdir()
        for index, picture in enumerate(pictures):
            linear = decode_table("srgb")[:, 0][picture] * (dark * (1.0, 1 / 4)[index % 2] if bits else 1.0)
            codes = encode_srgb(linear, 2**bits - 1 if bits else 255)
            codes = np.ascontiguousarray(codes[..., ::-1], np.uint16 if bits == 16 else np.uint8)
            cv2.imwrite(str(folder / f"{index}.png"), codes)
        if bits:
            (folder / "exposures.json").write_text(json.dumps([0.016, 0.004]))
        scene = make_scene(camera=camera, **({} if poses is None else {"pose": poses}))
        with Session(scene, source=folder, device=device, quality="low", outputs=("environment",)) as session:
            results = [result for _, result in session]
            found[bits] = np.array(results[-1].environment) / (dark if bits else 1.0)
        poses = poses or PoseSpec(tuple((tuple(r.pose.rotation.ravel()), tuple(r.pose.translation)) for r in results))
    error = {bits: np.median(np.abs(found[bits] - found[0])) / np.median(found[0]) for bits in (8, 16)}
    assert error[16] < 0.01 < error[8]


# ---- which exposures make a bracket ----


THIRDS = [1 / 125, 1 / 100, 1 / 80, 1 / 60, 1 / 50, 1 / 40]
"""As cameras round thirds of a stop."""


@pytest.mark.parametrize(
    ("exposures", "ratios"),
    [
        ([], ()),
        ([0.02], ()),
        ([0.01, 0.08, 0.02, 0.0805], (1.0, 0.02 / 0.0805, 0.01 / 0.0805)),  # a camera wavers
        ([0.02, 0.018, 0.016, 0.014, 0.012], ()),  # adapts to the light
        (THIRDS, tuple(40 * t for t in sorted(THIRDS, reverse=True))),
        ([0.1, 0.072, 0.01], (1.0, 0.72, 0.1)),  # 1.39 apart: both count
    ],
)
def test_brackets_are_told_from_adaption(exposures, ratios):
    plan = plan_bracket(exposures)
    assert plan.ratios == pytest.approx(ratios)
    assert bool(plan.notes) == (len(plan.ratios) < len(set(exposures)) and len(set(exposures)) > 1)


def test_exposures_that_are_too_many_are_thinned_and_said():
    plan = plan_bracket([2.0**-k for k in range(12)], shown=0.25)
    assert len(plan.ratios) == MOST_EXPOSURES
    assert {1.0, 4.0, 2.0**-9} <= set(plan.ratios)  # the shown one, the longest, the shortest
    assert len(plan.left_out) == 4
    assert "left out" in plan.notes[0]
    for ratio in plan.left_out:
        assert find_exposure(0.25 * ratio, plan) is None


def test_frames_are_told_apart_by_ratio():
    plan = plan_bracket([0.04, 0.01, 0.0004])
    assert [find_exposure(s, plan) for s in (None, 0.04, 0.03, 0.012, 0.009, 0.0005)] == [0, 0, 0, 1, 1, 2]
    assert find_exposure(0.01, plan_bracket([])) == 0
    shown = plan_bracket([0.04, 0.01, 0.0004], shown=0.01)
    assert shown.ratios == pytest.approx((4.0, 1.0, 0.04))
    assert [find_exposure(s, shown) for s in (None, 0.04, 0.0004)] == [1, 0, 2]
    with pytest.raises(UsageError, match=r"shown = 0.02 s.*0.04, 0.01"):
        plan_bracket([0.04, 0.01], shown=0.02)


@pytest.mark.parametrize("shown", [1, 2])
def test_any_exposure_can_be_the_shown_one(clip, device, shown):
    times = tuple(0.02 * ratio for ratio in RATIOS)
    found = []
    for choice in (0, shown):
        outputs, show = ("environment", "image"), times[choice]
        with Pipeline(make_scene(), device=device, quality="low", outputs=outputs, exposures=times, shown=show) as pipe:
            for index, (image, pose, seconds) in enumerate(clip * 2):
                result = pipe(image, time_seconds=index / 30, pose=pose, exposure_time=seconds)
                assert result.shown == (index % len(RATIOS) == choice)
            found.append(irradiance(np.array(result.environment, np.float64)) / RATIOS[choice])
    # The card is no part of these frames, so both rest on the bracket alone; the poses err by a third of a pixel.
    assert np.linalg.norm(found[1] - found[0]) < 0.1 * np.linalg.norm(found[0])
