"""Path-traced frames of a run, with the light and the poses that its pipeline finds: ``warp_ar.live --samples N``."""

from __future__ import annotations

import dataclasses
from typing import Any

from warp_ar.accuracy.known_frame import known_frame
from warp_ar.accuracy.path_tracer import Image
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError


@dataclasses.dataclass
class TracedFrames:
    """Path tracing of a pipeline's frames, with the pipeline's light and poses.

    Each frame must be passed before the pipeline begins the next one, because the pipeline holds only the latest light.
    """

    pipeline: Pipeline
    """Pipeline that lights the frames."""
    samples: int
    """Largest number of samples per pixel."""
    error: float | None = None
    """Relative standard error at which a frame is finished earlier."""
    first: float | None = dataclasses.field(default=None, init=False)
    """Time of the first frame in seconds, at which animations start."""

    def __post_init__(self) -> None:
        """Check that the pipeline's frames can be traced.

        Raises:
            UsageError: The pipeline adapts its quality to a budget.
        """
        if not isinstance(self.pipeline, Pipeline):
            raise UsageError("--samples needs a preset as --quality, which estimates the light; auto is none")

    def __call__(self, frame: Any, result: Any) -> Image:
        """Return the traced picture of a frame, or the pipeline's if the marker is lost or the frame is not shown."""
        self.first = frame.time if self.first is None else self.first
        if result.pose is None or not result.shown:
            return result.image  # type: ignore[no-any-return]
        known = known_frame(self.pipeline, frame.image, result, frame.time - self.first)
        tracer = known.tracer(device=str(self.pipeline.device))
        for picture in tracer.render(self.samples, error=self.error):
            traced = picture
        return traced.image
