"""The package's public face."""

from __future__ import annotations

import subprocess
import sys

import warp_ar

PUBLIC = {
    *(
        "LAYERS",
        "PRESETS",
        "Capture",
        "Light",
        "capture_light",
        "Frame",
        "Pipeline",
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


def test_import_does_not_initialise_warp() -> None:
    code = (
        "import warp_ar, sys; assert 'warp' not in sys.modules, 'importing the package loads Warp';"
        "import warp_ar.engine.pipeline, warp_ar.live, warp_ar.explain, warp as wp;"
        "assert wp._src.context.runtime is None, 'importing the modules initialises Warp'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
