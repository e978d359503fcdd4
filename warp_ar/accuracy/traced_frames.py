"""Frames of a run by path tracing, in the light that its pipeline finds: ``warp_ar.live --samples N``."""

from __future__ import annotations

import dataclasses
from typing import Any

from warp_ar.accuracy.known_frame import known_frame
from warp_ar.accuracy.path_tracer import Image
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError


@dataclasses.dataclass
class TracedFrames:
    """Replaces pictures of a pipeline's frames by the reference's, in the same light and pose.

    A frame must be handed over before the pipeline begins with the next one, whose light it would get otherwise.
    """

    pipeline: Pipeline
    samples: int
    """Per pixel, at most."""
    error: float | None = None
    """Relative standard error at which a frame is done before."""
    first: float | None = dataclasses.field(default=None, init=False)
    """Time of the first frame, in seconds: from there on what is animated moves."""

    def __post_init__(self) -> None:
        """Complain about what cannot be traced.

        Raises:
            UsageError: The pipeline keeps to a budget.
        """
        if not isinstance(self.pipeline, Pipeline):
            raise UsageError("--samples with --quality auto: name a preset, whose light is used")

    def __call__(self, frame: Any, result: Any) -> Image:
        """The picture of a frame; the pipeline's own where the marker is lost or the exposure is not that shown."""
        self.first = frame.time if self.first is None else self.first
        if result.pose is None or not result.shown:
            return result.image  # type: ignore[no-any-return]
        known = known_frame(self.pipeline, frame.image, result, frame.time - self.first)
        tracer = known.tracer(device=str(self.pipeline.device))
        for picture in tracer.render(self.samples, error=self.error):
            traced = picture
        return traced.image
