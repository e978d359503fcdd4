"""The worked examples of docs/developing.md: each is applied to a copy of the sources, and does what the page says."""

from __future__ import annotations

import pathlib
import re
import shutil
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

ROOT = pathlib.Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"

METHOD = """
import numpy as np, warp as wp
from warp_ar import Pipeline, Quality, load_scene
from warp_ar.stages.quality import PRESETS
quality = PRESETS["low"].with_methods(irradiance="mean")
with Pipeline(load_scene("torus"), device="cpu", quality=quality) as pipeline:
    stage = next(stage for stage, _ in pipeline.plan.stages if stage.name == "irradiance")
    assert "mean" in stage.methods
    arrays = pipeline.arrays
    arrays["environment"].fill_(wp.vec3(0.5, 1.0, 2.0))
    step = next(own for own in pipeline.scheduler._stages if own[0].name == "irradiance")
    for one in step[1]:
        one.launch(None)
    assert np.allclose(arrays["irradiance_map"].numpy(), np.pi * np.array([0.5, 1.0, 2.0]), rtol=1e-5)
"""
SOURCE = """
from warp_ar import open_source
with open_source("ramp:") as source:
    frames = list(source)
assert len(frames) == 24 and frames[3].image[0, 255].tolist() == [255, 255, 255]
"""
CASES = {
    "stage": (5, ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-n0", "tests/test_frame_luminance.py"]),
    "method": (2, ["-c", METHOD]),
    "scene-key": (1, ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-n0", "tests/test_key_tables.py"]),
    "source": (2, ["-c", SOURCE]),
}
"""Files that an example touches, and what Python runs to try it."""


@pytest.fixture
def copy(tmp_path: pathlib.Path) -> pathlib.Path:
    """The sources, without what is large."""
    for name in ("warp_ar", "kernels", "tests", "scenes"):
        shutil.copytree(
            ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "golden", "truth")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", CASES)
def test_example_applies_and_works(name: str, copy: pathlib.Path) -> None:
    count, command = CASES[name]
    patch = EXAMPLES / f"{name}.diff"
    assert len(re.findall(r"^diff --git ", patch.read_text(encoding="utf-8"), flags=re.M)) == count
    applied = subprocess.run(["git", "apply", str(patch)], cwd=copy, capture_output=True, text=True)
    assert applied.returncode == 0, f"{name}.diff no longer fits: make it again\n{applied.stderr}"
    run = subprocess.run([sys.executable, *command], cwd=copy, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]


def test_page_shows_every_example() -> None:
    page = (ROOT / "docs" / "developing.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`docs/examples/([\w-]+)\.diff`", page)) == set(CASES)
    assert {path.stem for path in EXAMPLES.glob("*.diff")} == set(CASES)
