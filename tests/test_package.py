"""The package's public face."""

from __future__ import annotations

import dataclasses
import pydoc
import re
import subprocess
import sys

import numpy as np
import pytest

import warp_ar
from warp_ar.scene import LambertMaterial, Object, loads_scene, sections

BALL = Object("sphere", radius=0.02, material=LambertMaterial((0.5, 0.5, 0.5)))

PUBLIC = {
    *(
        "LAYERS",
        "PRESETS",
        "Capture",
        "Light",
        "capture_light",
        "Frame",
        "Pipeline",
        "PipelineSwitcher",
        "Plan",
        "Pose",
        "Quality",
        "Result",
        "Scene",
        "SceneError",
        "Session",
        "SinkError",
    ),
    *(
        "SourceError",
        "TrackState",
        "Tracker",
        "UpdateError",
        "UsageError",
        "WarpArError",
        "bundled_scenes",
        "dumps_scene",
        "load_scene",
    ),
    *("make_plan", "open_sink", "open_source", "read_environment", "write_environment"),
}


def test_all_is_pinned_and_resolves() -> None:
    assert set(warp_ar.__all__) == PUBLIC
    for name in warp_ar.__all__:
        assert name in ("LAYERS", "PRESETS") or getattr(warp_ar, name).__doc__


def test_former_names_warn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(warp_ar._RENAMED, "Room", "Scene")
    with pytest.warns(DeprecationWarning, match=r"warp_ar\.Room is now Scene"):
        assert warp_ar.Room is warp_ar.Scene
    frame = warp_ar.Frame(0, 0.0, np.zeros((2, 2, 3), np.uint8))
    with pytest.warns(DeprecationWarning, match=r"Frame\.plate is now deep"):
        assert frame.plate is None
    monkeypatch.setitem(sections.RENAMED, "object.material.hue", "base_color")
    scene = warp_ar.load_scene("desk")
    text = warp_ar.dumps_scene(dataclasses.replace(scene, objects=(BALL,)))
    with pytest.warns(FutureWarning, match=r"object\[0\]\.material\.hue is now base_color"):
        assert loads_scene(text.replace("base_color", "hue"), scene.path).objects == (BALL,)


def test_help_names_the_fields_of_dataclasses() -> None:
    for kind, field in ((warp_ar.Frame, "exposure_time"), (warp_ar.Result, "pose"), (warp_ar.Quality, "edge_samples")):
        shown = pydoc.render_doc(kind, renderer=pydoc.plaintext)
        assert re.search(rf"^ \|      {field}: \w", shown, re.MULTILINE), kind
        assert "Attributes:" not in (pydoc.getdoc(kind.__init__) or "")


def test_import_does_not_initialise_warp() -> None:
    code = (
        "import warp_ar, sys; assert 'warp' not in sys.modules, 'importing the package loads Warp';"
        "import warp_ar.engine.pipeline, warp_ar.live, warp_ar.explain, warp as wp;"
        "assert wp._src.context.runtime is None, 'importing the modules initialises Warp'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
