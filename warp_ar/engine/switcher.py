"""Change from one pipeline to another between frames, while the new one is built on another thread.

The caller requests a target, the description of a pipeline (``want``). Before each frame it switches to the target if
its pipeline is ready (``take``). If the target differs from the running pipeline in numbers only, they are written into
that pipeline. Any other target is built on a separate thread. A new pipeline takes over the light, the clock and the
marker's track.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeAlias

from warp_ar.declared import check_fields, checked
from warp_ar.device import exclusive, release_memory
from warp_ar.engine.pipeline import Pipeline, cannot_run
from warp_ar.errors import UpdateError, UsageError, WarpArError
from warp_ar.scene import Scene
from warp_ar.sources.exposures import plan_bracket
from warp_ar.stages.quality import Quality

Prepare: TypeAlias = Callable[[Pipeline], Any]
"""Function that prepares a new pipeline on the builder's thread, before the pipeline lights a frame. Its result is
passed to ``Admit``."""

Admit: TypeAlias = Callable[[Pipeline, Any], bool]
"""Function that decides, on the thread that lights frames, whether a newly built pipeline may light them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """Description of a pipeline to build. Targets are compared by identity: make a new one only for a change."""

    scene: Scene
    """Scene to show."""
    quality: Quality
    """Quality of the pipeline."""
    size: tuple[int, int] | None = None
    """Width and height of the frames; None means the scene's."""
    outputs: tuple[str, ...] = ("image",)
    """Outputs of the pipeline."""
    exposures: tuple[float, ...] = ()
    """Exposure times in seconds between which the frames alternate."""
    shown: float | None = None
    """Exposure time in seconds of the frames that are shown; None means the longest."""

    def __post_init__(self) -> None:
        """Check the types of all values."""
        check_fields(self)


class PipelineSwitcher:
    """Holder of the pipeline that lights the next frame. One thread calls it; another thread builds pipelines."""

    @checked
    def __init__(self, *, builder: ThreadPoolExecutor | None = None, keep: int = 0, **arguments: Any) -> None:
        """Start without a pipeline.

        Args:
            builder: Thread pool on which pipelines are built; None makes one that ends with the switcher.
            keep: Largest number of former pipelines that are kept, to return to them without building.
            **arguments: Arguments of every ``Pipeline``, such as ``device``, ``bands`` and ``estimates``.

        Raises:
            UsageError: ``keep`` is below 0, or an argument has another type.
        """
        if keep < 0:
            raise UsageError(f"keep = {keep}: expected a number of pipelines, 0 or more")
        self._own_builder = ThreadPoolExecutor(1, "warp-ar-build") if builder is None else None
        self._builder = builder or self._own_builder
        # On CUDA only a profiling pipeline measures the time of each stage.
        self._keep, self._arguments = keep, {"profile": True, **arguments}
        self._kept: list[Pipeline] = []
        self._wanted: Target | None = None
        self._shown: Target | None = None
        self._refused: Target | None = None
        self._prepare: Prepare = Pipeline.warm_up
        self._building: Future[tuple[Pipeline, Any]] | None = None
        self._built_for: Target | None = None
        self.pipeline: Pipeline | None = None
        """Pipeline that lights the next frame; None until the first one is built and taken."""
        self.swaps = 0
        """Number of switches to another pipeline, the first included."""

    @property
    def busy(self) -> bool:
        """Return True while a pipeline is being built."""
        return self._building is not None

    @checked
    def want(self, target: Target, prepare: Prepare = Pipeline.warm_up) -> bool:
        """Request the target for the next frames; requesting the same target again changes nothing.

        Args:
            target: Description of the pipeline.
            prepare: Function that prepares a new pipeline on the builder's thread; the default loads every kernel.

        Returns:
            True if no pipeline has to be built, so that the next ``take`` switches to the target.
        """
        self._prepare = prepare
        if target is not self._wanted and target is not self._refused:
            self._wanted = target
            if self._building is None and self._ready() is None:
                self._start()
        return self._building is None

    def take(self, admit: Admit | None = None) -> Pipeline | None:
        """Switch to the requested target if its pipeline is ready.

        Args:
            admit: Function that is called for a newly built pipeline. If it returns False, the pipeline is discarded,
                and the previous target is requested again.

        Returns:
            The pipeline for the next frame; None before the first one is built.

        Raises:
            WarpArError: The requested pipeline cannot be built; the previous one stays in use.
        """
        if self._building is not None and self._building.done():
            building, self._building = self._building, None
            try:
                built = building.result()
            except Exception:  # after any error, the target is refused; else it would be built again for each frame
                if self._built_for is self._wanted:
                    self._refused, self._wanted = self._wanted, self._shown
                    raise
                # If another target is requested by now, the failure does not concern it.
            else:
                self._take_built(*built, admit)
        if self._wanted is not self._shown and self._building is None:
            ready = self._ready()
            if ready is None:
                self._start()
            else:
                self._go_over(ready)
        return self.pipeline

    def _take_built(self, pipeline: Pipeline, prepared: Any, admit: Admit | None) -> None:
        """Switch to a newly built pipeline, or dispose of it if it is no longer requested or not admitted."""
        if self._wanted is None or not _fits(pipeline, self._wanted):
            self._dispose(pipeline)  # another target is requested by now
        elif admit is not None and not admit(pipeline, prepared):
            self._dispose(pipeline)
            self._refused, self._wanted = self._wanted, self._shown
        else:
            self._go_over(pipeline)

    def shows(self, target: Target) -> bool:
        """Return True if the next frame is lit by the pipeline of this target."""
        return self._shown is target

    def follow(self, target: Target, *, prepare: Prepare = Pipeline.warm_up) -> Pipeline | None:
        """Request a target and switch to it if its pipeline is ready: ``want``, then ``take``.

        Args:
            target: Description of the pipeline for the next frames.
            prepare: Function that prepares a new pipeline on the builder's thread.

        Returns:
            The pipeline for the next frame: the previous one while the new one is built; None if there is none.

        Raises:
            WarpArError: The requested pipeline cannot be built; the previous one stays in use.
        """
        self.want(target, prepare)
        return self.take()

    def open(self, target: Target) -> Pipeline:
        """Build the first pipeline on this thread; its kernels are loaded by the first frame.

        Raises:
            WarpArError: The pipeline cannot be built.
        """
        pipeline = self._build(target, lambda _: None)[0]
        self._wanted = target
        self._go_over(pipeline)
        return pipeline

    def _ready(self) -> Pipeline | None:
        """Return a running or kept pipeline that fits the requested target; None if there is none."""
        assert self._wanted is not None
        # The latest pipeline comes first.
        known = [pipeline for pipeline in (self.pipeline, *reversed(self._kept)) if pipeline is not None]
        return next((pipeline for pipeline in known if _fits(pipeline, self._wanted)), None)

    def _start(self) -> None:
        assert self._builder is not None
        assert self._wanted is not None
        self._built_for = self._wanted
        self._building = self._builder.submit(self._build, self._wanted, self._prepare)

    def _build(self, target: Target, prepare: Prepare) -> tuple[Pipeline, Any]:
        pipeline: Pipeline | None = None
        try:
            pipeline = Pipeline(
                target.scene,
                quality=target.quality,
                size=target.size,
                outputs=target.outputs,
                exposures=target.exposures,
                shown=target.shown,
                **self._arguments,
            )
            return pipeline, prepare(pipeline)
        except (RuntimeError, MemoryError) as error:
            if pipeline is not None:
                pipeline.close()
            if isinstance(error, WarpArError):
                raise
            raise cannot_run(target.quality, error) from error  # the running pipeline stays in use

    def _go_over(self, pipeline: Pipeline) -> None:
        before = self.pipeline
        if before is not None and pipeline is not before:
            pipeline.continue_from(before)  # comes first: if it raises a frame's error, the previous pipeline stays
        self._shown = self._wanted
        if pipeline is before:
            return
        if pipeline in self._kept:
            self._kept.remove(pipeline)
        self.pipeline = pipeline
        self.swaps += 1
        if before is not None:
            self._kept.append(before)
            while len(self._kept) > self._keep:
                self._dispose(self._kept.pop(0))

    def _dispose(self, pipeline: Pipeline) -> None:
        """Close a pipeline on the builder's thread, so that frames do not wait for it."""
        assert self._builder is not None
        self._builder.submit(let_go, pipeline)

    def close(self, *, wait: bool = True) -> None:
        """Close every pipeline. The switcher can be used again, unless the builder was its own.

        Args:
            wait: True to wait for a build in progress; otherwise its pipeline is closed when it is built.
        """
        building, self._building = self._building, None
        if building is not None:
            building.add_done_callback(_close_built)
            if wait:
                building.exception()
        pipelines = [*self._kept, *([] if self.pipeline is None else [self.pipeline])]
        self._kept.clear()
        self.pipeline = self._wanted = self._shown = self._refused = None
        for pipeline in pipelines:
            if self._own_builder is None:
                self._dispose(pipeline)
            else:
                pipeline.close()
        if self._own_builder is not None:
            self._own_builder.shutdown(wait=wait)


def _fits(pipeline: Pipeline, target: Target) -> bool:
    """Return True if a pipeline fits a target; numbers of the scene that differ are written into the pipeline."""
    request = pipeline.plan.request
    camera = target.scene.camera
    size = (camera.width, camera.height) if target.size is None else target.size
    same = (request.quality, pipeline.size, request.outputs) == (target.quality, size, target.outputs)
    if not same or pipeline.bracket != plan_bracket(target.exposures, target.shown):
        return False
    try:
        pipeline.update(target.scene)
    except UpdateError:
        return False
    return True


def let_go(pipeline: Pipeline) -> None:
    """Close a pipeline and free its arrays at once; it cannot be used again."""
    device, scheduler = pipeline.device, pipeline.scheduler
    pipeline.close()
    scheduler.let_go()
    with exclusive(device):
        vars(pipeline).clear()
    release_memory()


def _close_built(building: Future[tuple[Pipeline, Any]]) -> None:
    if not building.cancelled() and building.exception() is None:
        let_go(building.result()[0])
