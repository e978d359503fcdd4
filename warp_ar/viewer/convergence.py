"""The reference of a held frame, as it converges: a slice of its samples between two pictures of the page.

Paths are followed in the light, pose and scene of the frame as it was lit last. Whatever moves on (frames that flow, an
edit, another plan) drops it, and the next held frame begins anew.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final

import cv2
import numpy as np

from warp_ar.accuracy.known_frame import KnownFrame, exposed_scene, light_of
from warp_ar.accuracy.path_tracer import Image, PathTracer, TracedPicture
from warp_ar.device import exclusive
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.viewer.controls import TRACED

FULL_SCALE: Final = 0.2
"""Difference, of full scale, that has the last colour."""
SLICE_SECONDS: Final = 0.04
"""Of samples, between two looks at what viewers ask for."""
SHOWN_SECONDS: Final = 0.3
"""Between two pictures at least."""
LIGHT_SAMPLES: Final = 8
"""Per pixel, by which the reflectance of proxies is found; fewer than offline, for somebody waits."""
LEAST_SAMPLES: Final = 16
"""Per pixel, before which an error is not believed."""
GOAL: Final = 0.002
"""Relative standard error at which a picture rests."""
MOST_SAMPLES: Final = 4096
"""Per pixel, after which it does, too."""


def false_colors(image: Image, reference: Image) -> Image:
    """The largest channel's difference as a colour, black at none and light yellow from FULL_SCALE on."""
    off = np.abs(image.astype(np.int16) - reference.astype(np.int16)).max(axis=2)
    share = np.clip(off / (255.0 * FULL_SCALE), 0.0, 1.0)
    colors = cv2.applyColorMap(np.round(255.0 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(colors[..., ::-1])


def _is_done(picture: TracedPicture) -> bool:
    """Whether no more samples are added."""
    if picture.samples < LEAST_SAMPLES:
        return False
    return picture.samples >= MOST_SAMPLES or picture.relative_error <= GOAL


class Convergence:
    """Follows paths of one held frame. The thread of the frames calls it; ``status`` may be read by any."""

    def __init__(self) -> None:
        self._key: Any = None
        self._made: Future[PathTracer] | None = None
        self._picture: TracedPicture | None = None
        self._lit: Image | None = None
        self._shown = 0.0
        self.status: dict[str, float] | None = None
        """What viewers are told of it; None while there is no picture."""

    def begin(
        self,
        key: Any,
        pipeline: Pipeline,
        frame: Image,
        result: Result,
        seconds: float,
        builder: ThreadPoolExecutor,
    ) -> None:
        """Trace a frame that was just lit, unless it is the one in hand.

        Args:
            key: What the picture is of; another one begins anew.
            pipeline: That lit it.
            frame: As the camera gave it.
            result: What the pipeline made of it.
            seconds: On the pipeline's clock: where what is animated stands.
            builder: Compiles, uploads and takes the first sample beside the frames.
        """
        if key == self._key or result.pose is None:
            return
        self.drop()
        with exclusive(pipeline.device):
            light, scene = light_of(pipeline), exposed_scene(pipeline)
        known = KnownFrame(
            scene, frame.copy(), result.image, result.pose, light, seconds, 0.0, pipeline.plan.features.others + 1
        )
        self._key, self._lit = key, result.image

        def make() -> PathTracer:
            tracer = known.tracer(device=str(pipeline.device), light_samples=LIGHT_SAMPLES)
            # All kernels are compiled here, so that no slice waits for that; what is dropped meanwhile ends.
            while self._key is key and not tracer.sample_for(SLICE_SECONDS):
                pass
            if tracer.samples > 0:
                tracer.picture()
            return tracer

        self._made = builder.submit(make)

    def drop(self) -> None:
        """Forget the picture: something moves on."""
        if self._made is not None:
            self._made.cancel()
        self._key = self._made = self._picture = self._lit = self.status = None

    def wants(self, key: Any) -> bool:
        """Whether samples are still to be added to the picture of ``key``."""
        if key != self._key or self._made is None:
            return False
        picture = self._picture
        return picture is None or not _is_done(picture)

    def rests(self, key: Any) -> bool:
        """Whether the picture of ``key`` is as good as it gets."""
        return key == self._key and self._picture is not None and _is_done(self._picture)

    def step(self) -> bool:
        """Add a slice of samples; whether there is a new picture to show.

        Raises:
            Exception: The frame cannot be traced, such as on a device whose memory is full; it is not tried again.
        """
        made = self._made
        if made is None or not made.done():
            time.sleep(0.5 * SLICE_SECONDS)
            return False
        try:
            tracer = made.result()
            tracer.sample_for(SLICE_SECONDS)
        except Exception:
            self._made = None  # the picture goes on without a reference
            raise
        now = time.monotonic()
        if tracer.samples < 1 or now - self._shown < SHOWN_SECONDS:
            return False
        picture, lit = tracer.picture(), self._lit
        if lit is None:
            return False
        self._shown, self._picture, self.status = now, picture, self._told(picture, lit)
        return True

    def other(self, key: Any, compare: str) -> Image | None:
        """What stands beside the picture; None until there is one."""
        picture, lit = self._picture, self._lit
        if key != self._key or picture is None or lit is None:
            return None
        return picture.image if compare == TRACED else false_colors(lit, picture.image)

    def _told(self, picture: TracedPicture, lit: Image) -> dict[str, float]:
        """Samples, relative standard error and mean difference of the picture; all but the first in per cent."""
        off = float(cv2.norm(lit, picture.image, cv2.NORM_L1)) / lit.size
        return {
            "samples": picture.samples,
            "error": round(100.0 * picture.relative_error, 2),
            "goal": 100.0 * GOAL,
            "done": _is_done(picture),
            "difference": round(100.0 * off / 255.0, 3),
            "scale": 100.0 * FULL_SCALE,
        }
