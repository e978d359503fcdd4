"""Every bundled scene against golden frames: nothing that users see changes unnoticed.

``pytest tests/test_golden.py --update-golden`` writes the frames anew; look at them before committing.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import bundled_scenes, load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages.quality import PRESETS, Quality

GOLDEN = Path(__file__).parent / "golden"
SCENES = ("darken", "desk", "mirror", "product", "screen", "torus", "wire_coincident", "wire_opposing")
SIZE = (320, 240)
FRAMES = 5  # the last one is compared: by then the light has been accumulated over several
QUALITY = PRESETS["medium"]
CASES = {
    **{name: (name, QUALITY) for name in SCENES},
    "desk_bounce": ("desk", QUALITY.with_methods(relight="bounce")),
    **{f"{name}_paper": (name, PRESETS["paper"]) for name in SCENES},
    **{f"{name}_high": (name, PRESETS["high"]) for name in ("desk", "torus", "mirror")},
}
"""Scene and quality of every golden frame."""
SLOW = {"screen", "product", "desk_bounce", "screen_paper", "product_paper", "torus_high", "mirror_high"}
"""Frames whose long kernels no other test needs."""

# Codes. Video decoders may differ by a code or two, CPU and CUDA by rounding; both are spread over all pixels.
MEAN_TOLERANCE = 0.5
# Share of pixels that may differ by more than LARGE codes: a ray that grazes an edge may fall on either side of it.
LARGE = 8
LARGE_SHARE = 0.002


def render(name: str, quality: Quality, device: str) -> npt.NDArray[np.uint8]:
    """The last of a scene's first frames, halved in size and lit."""
    scene = load_scene(name)
    assert scene.source is not None
    assert scene.source.path is not None
    with (
        open_source(scene.source.path) as source,
        Pipeline(scene, device=device, quality=quality, size=SIZE) as pipeline,
    ):
        for frame in itertools.islice(source, FRAMES):
            small = cv2.resize(frame.image, SIZE, interpolation=cv2.INTER_AREA)
            result = pipeline(small.astype(np.uint8), time_seconds=frame.time)
        return result.image


def test_every_bundled_scene_has_a_test() -> None:
    assert set(SCENES) == set(bundled_scenes())


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CASES])
def test_golden(name: str, device: str, request: pytest.FixtureRequest) -> None:
    image = render(*CASES[name], device)
    path = GOLDEN / f"{name}.png"
    if request.config.getoption("--update-golden"):
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), image[..., ::-1])
        pytest.skip(f"wrote {path.name}: look at it")
    golden = cv2.imread(str(path))
    assert golden is not None, f"{path} is missing: run with --update-golden"
    difference = np.abs(image.astype(int) - golden[..., ::-1])
    assert difference.mean() <= MEAN_TOLERANCE
    assert (difference.max(axis=-1) > LARGE).mean() <= LARGE_SHARE
