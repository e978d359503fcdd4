"""What a stage is: what it reads and writes, the methods it has, and the passes that do its work.

A stage has two lives. While a plan is made, only its class speaks: ``wire`` says, from the scene and the quality alone,
what it would read and write, or why the scene does not call for it. Nothing of Warp is touched then. When a pipeline is
built, ``build`` turns a wired stage into passes over arrays that have been allocated from what ``arrays`` declared.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

from warp_ar.scene import Scene
from warp_ar.stages.quality import Quality

Rows = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Request:
    """What a plan is made for; equal requests give equal plans."""

    scene: Scene
    """What the user wants to see."""
    quality: Quality
    """The method of every stage, and its numbers."""
    size: tuple[int, int]
    """Width and height of the frames in pixels."""
    outputs: tuple[str, ...] = ("image",)
    """Names of the resources that the caller wants: ``image``, ``environment``, ``pose``."""
    exposures: tuple[float, ...] = ()
    """Exposures between which frames alternate, as ratios to the longest, which comes first; empty: only one."""
    waits: bool = False
    """Whether a frame waits for what is estimated from it; else that takes effect some frames later."""


@dataclasses.dataclass(frozen=True)
class Wiring:
    """Names of the resources that a stage reads and writes."""

    reads: tuple[str, ...]
    writes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Why a stage is not part of a plan."""

    reason: str


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """An array to allocate when a pipeline is built."""

    shape: tuple[int, ...]
    """Extent, outermost first."""
    dtype: Any
    """Warp type of an element."""
    fill: Any = 0
    """Initial value of every element."""


@dataclasses.dataclass(frozen=True)
class Pass:
    """One launch (or a short fixed series): everything in it may run side by side, the next pass waits for it."""

    launch: Callable[[Rows | None], None]
    """Calls the stage's launcher; the argument is the band of rows, None for all."""
    rows: int | None = None
    """Rows to split into bands on CPU; None means that it cannot be split."""
    extent: Callable[[], Rows] | None = None
    """Rows that matter in this frame, asked on CPU before splitting; None means all."""
    on_host: bool = False
    """Works on the host between launches: it cannot be part of a captured graph, which is cut where it is due."""
    due: Callable[[], bool] | None = None
    """Whether the pass takes part in this frame, asked once, after ``Stage.begin``; None means always."""


class Arrays(Mapping[str, Any]):
    """The named arrays of a pipeline, with a version each: a number that grows whenever the contents change."""

    def __init__(self) -> None:
        self._arrays: dict[str, Any] = {}
        self._versions: dict[str, int] = {}

    def __getitem__(self, name: str) -> Any:
        return self._arrays[name]

    def __iter__(self) -> Any:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def add(self, name: str, array: Any) -> None:
        """Add a resource under a new name; its version starts at 0, which means never written."""
        if name in self._arrays:
            raise ValueError(f"resource {name!r} is already there: two stages may not own one resource")
        self._arrays[name] = array
        self._versions[name] = 0

    def touch(self, name: str) -> None:
        """Say that the contents of ``name`` changed."""
        self._versions[name] += 1

    def version(self, name: str) -> int:
        """Version of ``name``: 0 until it is first written."""
        return self._versions[name]

    def versions(self, names: Iterable[str]) -> tuple[int, ...]:
        """Versions of several."""
        return tuple(map(self._versions.__getitem__, names))


class Stage(abc.ABC):
    """One step on the way of a frame."""

    name: ClassVar[str]
    """As in reports and in ``Quality``."""
    methods: ClassVar[tuple[str, ...]]
    """Ways to do the work, cheapest first."""
    summary: ClassVar[str]
    """What it does, in one line for ``explain``."""
    remembers: ClassVar[tuple[str, ...]] = ()
    """Its arrays that carry over from frame to frame, and so to the pipeline of another quality."""

    def __init__(self, request: Request, wiring: Wiring) -> None:
        self.request = request
        self.wiring = wiring

    @property
    def method(self) -> str:
        """The method that the quality picks."""
        return self.request.quality.method(self.name)

    @classmethod
    @abc.abstractmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Say what the stage would read and write for ``request``, or why the scene does not call for it."""

    @abc.abstractmethod
    def arrays(self) -> Mapping[str, ArraySpec]:
        """Arrays that the stage owns: all that it writes, and its scratch space under names that begin with its own."""

    @abc.abstractmethod
    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Passes that do the work on ``arrays``; compiles what it needs by asking for its kernels."""

    def begin(self) -> None:  # noqa: B027  (most stages treat all frames alike)
        """Called once in every frame in which the stage runs, before any of its passes."""

    def host_kernels(self) -> tuple[Any, ...]:
        """Kernels that its steps on the host launch: they are compiled with the others."""
        return ()

    def gives_way(self) -> tuple[str, ...]:
        """Names of stages that are slower beside this one than before it: on CUDA it waits for them.

        For a stage that nobody waits for before those are done, and that fills the device by itself.
        """
        return ()

    def close(self) -> None:  # noqa: B027
        """Let go of what the stage holds beside arrays: its threads."""

    def changed(self, name: str) -> bool:
        """Whether the last run changed the written resource ``name`` enough for its readers to run again."""
        return True

    def resume(self, other: Stage) -> None:  # noqa: B027  (most stages remember nothing on the host)
        """Take over what the same stage of another pipeline remembers on the host; its arrays have been copied."""
