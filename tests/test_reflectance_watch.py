"""What balls reflect is told by frames where the scene is wrong about it, and left alone where it is right."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from warp_ar import PRESETS, Pipeline
from warp_ar.ball.ball_reflectance import measure_reflectance
from warp_ar.ball.reflectance_watch import ReflectanceWatch
from warp_ar.calibration.saturation import ball_discs
from warp_ar.checks.check_pictures import take_look
from warp_ar.kernels.color import decode_table
from warp_ar.live_clip import reflectances_told
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source

pytestmark = pytest.mark.slow

TOLD = 0.08
"""Relative error of one frame: the desk's texture is mirrored smaller than it is seen."""
ROUNDED = 0.02
"""Relative error of codes."""
"""Relative: four roundings of float32. OpenCV adds in another order at the end of a row."""


def said(reflectance, clip="desk"):
    """A scene that says this of its ball."""
    scene = load_scene(clip)
    return dataclasses.replace(scene, probes=(dataclasses.replace(scene.probes[0], reflectance=reflectance),))


@functools.lru_cache(maxsize=2)
def view(clip="desk"):
    """A picture of a clip and its pose."""
    scene = load_scene(clip)
    with open_source(str(scene.source.path)) as source:
        return take_look(scene, source, 1).views[0]


def watch(scene):
    return ReflectanceWatch(scene, scene.camera, decode_table(scene.camera.transfer).astype(np.float32))


@pytest.mark.parametrize("clip", ["desk", "wire_opposing"])
@pytest.mark.parametrize("wrong", [(0.6, 0.6, 0.6), (0.85, 0.6, 0.4)])
def test_frames_take_the_place_of_a_wrong_reflectance(clip, wrong):
    """Grey or tinted; the clips' balls have 0.85, 0.85, 0.87."""
    scene = said(wrong, clip)
    looks = watch(scene)
    assert looks.observe(*view(clip), scene.probes)
    assert looks.is_told
    assert looks.values[0] == pytest.approx(load_scene(clip).probes[0].reflectance, rel=TOLD)


def test_a_reflectance_that_frames_agree_with_is_kept_as_it_is():
    scene = load_scene("desk")
    looks = watch(scene)
    assert not looks.observe(*view(), scene.probes)
    assert looks.values == (scene.probes[0].reflectance,)
    assert not looks.is_told


def beside(factor, clip="wire_opposing"):
    """What is told where all beside the ball is brighter, by a factor for each column (width,), as codes of sRGB."""
    scene, (image, pose) = load_scene(clip), view(clip)
    table = decode_table(scene.camera.transfer).astype(np.float32)
    ((x, y, radius),) = ball_discs(scene.probes, scene.camera, pose)
    row, column = np.mgrid[: image.shape[0], : image.shape[1]]
    outside = np.hypot(column - x, row - y) > 1.05 * radius
    linear = np.take_along_axis(table, image.reshape(-1, 3).astype(int), axis=0).reshape(image.shape)
    bright = np.where(outside[..., None], linear * factor[None, :, None], linear)
    codes = np.stack([np.interp(bright[..., c], table[:, c], np.arange(256.0)) for c in range(3)], -1)
    return measure_reflectance(scene, scene.camera, scene.probes[0], (np.round(codes).astype(np.uint8), pose), table)


def test_what_shines_beside_the_ball_tells_nothing():
    """Evenly brighter is a ball that reflects less; brighter to one side is a surface that shines."""
    width = load_scene("wire_opposing").camera.width
    even, less = beside(np.ones(width)), beside(np.full(width, 1.2))
    assert np.array(less.reflectance) * 1.2 == pytest.approx(np.array(even.reflectance), rel=ROUNDED)
    assert beside(np.linspace(0.4, 2.0, width)) is None


def test_the_light_is_that_of_a_scene_which_says_so():
    """A pipeline that a frame tells lights as one whose scene says the same, to the bit; `paper` believes the scene."""
    image, pose = view()

    def lit(scene, quality):
        pipeline = Pipeline(scene, device="cpu", quality=PRESETS[quality], outputs=("environment",))
        try:
            environment = np.array(pipeline(image, time_seconds=0.0, pose=pose).environment)
            status = pipeline.arrays["recover_status"]() if "recover_status" in pipeline.arrays else {}
            return environment, status.get("ball_reflectance"), pipeline.inputs.told_reflectance
        finally:
            pipeline.close()

    wrong = said((0.5, 0.5, 0.5))
    found, reported, told = lit(wrong, "low")
    assert reported == [[pytest.approx(value, abs=1e-3) for value in told[0]]]
    again, reported, _ = lit(said(told[0]), "low")
    assert reported is None
    assert np.array_equal(found, again)
    assert lit(wrong, "paper")[2] is None


def test_another_pipeline_of_the_same_scene_goes_on_with_what_was_told():
    image, pose = view()
    scene = said((0.5, 0.5, 0.5))
    first = Pipeline(scene, device="cpu", quality=PRESETS["low"], outputs=("environment",))
    second = Pipeline(scene, device="cpu", quality=PRESETS["medium"], outputs=("environment",))
    try:
        first(image, time_seconds=0.0, pose=pose)
        second.continue_from(first)
        assert second.inputs.told_reflectance == first.inputs.told_reflectance
        probes = second.arrays["probes"].numpy()
        assert probes["reflectance"][0] == pytest.approx(np.array(first.inputs.told_reflectance[0]), rel=1e-6)
    finally:
        first.close()
        second.close()


def test_a_run_says_which_reflectances_were_taken():
    first, second = said((0.5, 0.5, 0.5)).probes[0], said((0.85, 0.85, 0.87)).probes[0]
    status = {"ball_reflectance": [[0.61, 0.62, 0.63], [0.85, 0.85, 0.87]]}
    (line,) = reflectances_told((first, second), lambda: status)
    assert "mirror ball 0" in line
    assert "0.61, 0.62, 0.63" in line
    assert "0.50, 0.50, 0.50" in line
    assert reflectances_told((first, second), dict) == []
    assert reflectances_told((first, second), None) == []
