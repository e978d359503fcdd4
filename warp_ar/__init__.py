"""Consistent light for augmented reality, in NVIDIA Warp kernels.

A mirror ball beside a printed marker captures the environment. Its light shades virtual objects, and virtual lights
fall on the real desk. ``Session`` opens a scene and lights its frames; ``Pipeline`` lights frames that the caller
provides; ``warp_ar.kernels`` has the launchers of single steps. Importing this package does not initialise Warp.
"""

# ruff: noqa: I001
from __future__ import annotations

import importlib

TYPE_CHECKING = False  # importing typing for it takes time, during which no command handles signals
if TYPE_CHECKING:
    from typing import Any

    # "as" tells type checkers that a name is public; isort would give each a statement of its own.
    from warp_ar.engine.graph import Plan as Plan, make_plan as make_plan
    from warp_ar.engine.pipeline import Pipeline as Pipeline, Result as Result
    from warp_ar.engine.switcher import PipelineSwitcher as PipelineSwitcher
    from warp_ar.errors import (
        SceneError as SceneError,
        SinkError as SinkError,
        SourceError as SourceError,
        UpdateError as UpdateError,
        UsageError as UsageError,
        WarpArError as WarpArError,
    )
    from warp_ar.light.captured import Light as Light
    from warp_ar.output.environment_file import (
        read_environment as read_environment,
        write_environment as write_environment,
    )
    from warp_ar.output.sinks import open_sink as open_sink
    from warp_ar.photo_capture import Capture as Capture, capture_light as capture_light
    from warp_ar.scene import (
        Pose as Pose,
        Scene as Scene,
        bundled_scenes as bundled_scenes,
        dumps_scene as dumps_scene,
        load_scene as load_scene,
    )
    from warp_ar.session import Session as Session
    from warp_ar.sources.source import Frame as Frame
    from warp_ar.sources.sources import open_source as open_source
    from warp_ar.stages.quality import PRESETS as PRESETS, Quality as Quality
    from warp_ar.stages.request import LAYERS as LAYERS
    from warp_ar.tracking.tracking import Tracker as Tracker, TrackState as TrackState

_HOMES = {
    "errors": ("SceneError", "SinkError", "SourceError", "UpdateError", "UsageError", "WarpArError"),
    "engine.graph": ("Plan", "make_plan"),
    "engine.pipeline": ("Pipeline", "Result"),
    "engine.switcher": ("PipelineSwitcher",),
    "stages.quality": ("PRESETS", "Quality"),
    "stages.request": ("LAYERS",),
    "scene": ("Pose", "Scene", "bundled_scenes", "dumps_scene", "load_scene"),
    "light.captured": ("Light",),
    "photo_capture": ("Capture", "capture_light"),
    "session": ("Session",),
    "output.environment_file": ("read_environment", "write_environment"),
    "output.sinks": ("open_sink",),
    "sources.source": ("Frame",),
    "sources.sources": ("open_source",),
    "tracking.tracking": ("TrackState", "Tracker"),
}
_RENAMED: dict[str, str] = {}
"""Former public names, which work with a warning for one minor version, and their present names."""
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


class _Help:
    """Docstring of a dataclass followed by the docstrings of its fields, composed when it is read."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __get__(self, instance: object, owner: type[Any]) -> str:
        from warp_ar.scene.key_tables import field_docs

        fields = (f"    {name}: {text}" for name, text in field_docs(owner).items() if not name.startswith("_"))
        return "\n".join([self.text, "", "Attributes:", *fields])


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that a scene can be read without loading OpenCV or Warp.

    Raises:
        AttributeError: There is no such name.
    """
    if name in _RENAMED:
        from warp_ar.errors import warn_renamed

        warn_renamed(f"warp_ar.{name}", _RENAMED[name])
        name = _RENAMED[name]
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    own = vars(found).get("__doc__") if isinstance(found, type) and hasattr(found, "__dataclass_fields__") else None
    if isinstance(own, str):
        found.__doc__ = _Help(own)
    return found


def __dir__() -> list[str]:
    return __all__
