"""One way from one pipeline to another while frames run: built beside the running one, swapped in between two frames.

Whoever lights frames says what it wants (``want``) and, before each frame, goes over to it if it is there (``take``).
What differs from the running pipeline in numbers alone is written into that one; all else is built on a thread of its
own. A new pipeline takes over the light, the clock and the track of the marker.
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
"""Function that prepares a new pipeline on the builder's thread, before it lights a frame; its result goes to
``Admit``.
"""

Admit: TypeAlias = Callable[[Pipeline, Any], bool]
"""Function that says, on the thread that lights frames, whether a pipeline that was just built may light them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """Description of the pipeline to build. Targets are compared by identity: make one only when something changed."""

    scene: Scene
    quality: Quality
    size: tuple[int, int] | None = None
    """Width and height of the frames; None means the scene's."""
    outputs: tuple[str, ...] = ("image",)
    exposures: tuple[float, ...] = ()
    """Exposure times in seconds between which the frames alternate."""
    shown: float | None = None
    """That of the frames that are shown; None means the longest."""

    def __post_init__(self) -> None:
        """Check the types of all values."""
        check_fields(self)


class PipelineSwitcher:
    """Holds the pipeline that lights the next frame. One thread calls it; another builds."""

    @checked
    def __init__(self, *, builder: ThreadPoolExecutor | None = None, keep: int = 0, **arguments: Any) -> None:
        """Start without a pipeline.

        Args:
            builder: Thread that builds; None makes one that ends with the switcher.
            keep: Pipelines that have lit frames and are kept for coming back to them.
            **arguments: For every ``Pipeline``: ``device``, ``bands``, ``estimates``.

        Raises:
            UsageError: ``keep`` is below 0, or an argument of another type.
        """
        if keep < 0:
            raise UsageError(f"keep = {keep}: expected a number of pipelines, 0 or more")
        self._own_builder = ThreadPoolExecutor(1, "warp-ar-build") if builder is None else None
        self._builder = builder or self._own_builder
        # On CUDA only a pipeline that profiles knows what each stage takes.
        self._keep, self._arguments = keep, {"profile": True, **arguments}
        self._kept: list[Pipeline] = []
        self._wanted: Target | None = None
        self._shown: Target | None = None
        self._refused: Target | None = None
        self._prepare: Prepare = Pipeline.warm_up
        self._building: Future[tuple[Pipeline, Any]] | None = None
        self._built_for: Target | None = None
        self.pipeline: Pipeline | None = None
        """Pipeline that lights the next frame; None until something was taken."""
        self.swaps = 0
        """Number of times that another pipeline has taken over, the first included."""

    @property
    def busy(self) -> bool:
        """Return whether a pipeline is being built."""
        return self._building is not None

    @checked
    def want(self, target: Target, prepare: Prepare = Pipeline.warm_up) -> bool:
        """Say what the next frames shall be lit by; the same target again changes nothing.

        Args:
            target: What to build for.
            prepare: Run on the builder's thread; the default loads every kernel.

        Returns:
            Whether a pipeline for it is there, so that the next ``take`` goes over to it.
        """
        self._prepare = prepare
        if target is not self._wanted and target is not self._refused:
            self._wanted = target
            if self._building is None and self._ready() is None:
                self._start()
        return self._building is None

    def take(self, admit: Admit | None = None) -> Pipeline | None:
        """Go over to what is wanted, if it is there.

        Args:
            admit: Asked about a pipeline that was just built; if refused, what ran before stays wanted.

        Returns:
            The pipeline for the next frame; None before the first is built.

        Raises:
            WarpArError: The wanted pipeline cannot be built; the one before stays, and stays wanted.
        """
        if self._building is not None and self._building.done():
            building, self._building = self._building, None
            try:
                built = building.result()
            except Exception:  # one that is no WarpArError, too: it would be built again before each frame
                if self._built_for is self._wanted:
                    self._refused, self._wanted = self._wanted, self._shown
                    raise
                # Something else is wanted by now, of which that says nothing.
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
        """Go over to a pipeline that was just built, or let it go."""
        if self._wanted is None or not _fits(pipeline, self._wanted):
            self._dispose(pipeline)  # something else is wanted by now
        elif admit is not None and not admit(pipeline, prepared):
            self._dispose(pipeline)
            self._refused, self._wanted = self._wanted, self._shown
        else:
            self._go_over(pipeline)

    def shows(self, target: Target) -> bool:
        """Return whether the next frame is lit as a target asks for."""
        return self._shown is target

    def follow(self, target: Target, *, prepare: Prepare = Pipeline.warm_up) -> Pipeline | None:
        """``want`` and ``take`` in one.

        Args:
            target: What frames are to be lit by.
            prepare: Makes a new pipeline ready, on the thread that builds it.

        Returns:
            What lights the next frame: the pipeline before, while the new one is built; None while there is none.

        Raises:
            WarpArError: As ``take``.
        """
        self.want(target, prepare)
        return self.take()

    def open(self, target: Target) -> Pipeline:
        """Build the first pipeline on this thread, its kernels still to be loaded by the first frame.

        Raises:
            WarpArError: It cannot be built.
        """
        pipeline = self._build(target, lambda _: None)[0]
        self._wanted = target
        self._go_over(pipeline)
        return pipeline

    def _ready(self) -> Pipeline | None:
        """A pipeline that is there and does what is wanted."""
        assert self._wanted is not None
        # The latest first.
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
            raise cannot_run(target.quality, error) from error  # and what runs goes on

    def _go_over(self, pipeline: Pipeline) -> None:
        before = self.pipeline
        if before is not None and pipeline is not before:
            pipeline.continue_from(before)  # first: it tells of a frame that failed, and the one before then stays
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
        """Let a pipeline go, on the builder's thread: frames do not wait for it."""
        assert self._builder is not None
        self._builder.submit(let_go, pipeline)

    def close(self, *, wait: bool = True) -> None:
        """Let every pipeline go. It can be used again, unless its builder was its own.

        Args:
            wait: Wait for what is being built; else it goes as soon as it is.
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
    """Return whether a pipeline does what a target asks for, with its numbers changed where that is enough."""
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
    """Close a pipeline and free its arrays now; it cannot be used again."""
    device, scheduler = pipeline.device, pipeline.scheduler
    pipeline.close()
    scheduler.let_go()
    with exclusive(device):
        vars(pipeline).clear()
    release_memory()


def _close_built(building: Future[tuple[Pipeline, Any]]) -> None:
    if not building.cancelled() and building.exception() is None:
        let_go(building.result()[0])
