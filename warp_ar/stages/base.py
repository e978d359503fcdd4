"""Base classes of stages: resources that they read and write, their methods, and passes.

A stage is used in two phases. During planning only its class is used: from the request's features, ``wire`` returns the
resources that the stage would read and write, or the reason that the scene does not need it. Warp is not used then.
When a pipeline is built, ``build`` returns the passes of a wired stage, over arrays that were allocated as ``arrays``
declared.

All facts about a stage are in its class: methods with their descriptions for tables, numerical precision, and the
settings of ``Quality`` that it shares with other stages. Stages depend on the features, never on each other.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from warp_ar.stages.features import Features

Rows = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Wiring:
    """Names of the resources (arrays and tables of a pipeline) that a stage reads and writes."""

    reads: tuple[str, ...]
    writes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Reason that a stage is not part of a plan."""

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
class Reach:
    """Parts of a frame that virtual objects and lights can reach, known on the host before any stage runs."""

    objects: bool = True
    """True if a virtual object may be in the picture."""
    shines: bool = True
    """True if a virtual light has power."""
    falls: bool = True
    """True if virtual light may fall on the receiver, inside or outside the picture."""
    light: bool = True
    """True if virtual light may fall on the receiver in the picture."""
    shadows: bool = True
    """True if a virtual object may change the environment's light on the receiver in the picture."""
    balls: bool = True
    """True if a mirror ball may be in the picture."""


OUT_OF_PICTURE = "no virtual object is in the picture"
"""Reason for which several stages are idle in a frame."""


@dataclasses.dataclass(frozen=True)
class Pass:
    """One launch or a short fixed series of launches, split into bands that may run in parallel.

    The next pass waits until all bands are done.
    """

    launch: Callable[[Rows | None], None]
    """Function that calls the stage's launcher; its argument is the band of rows, None for all."""
    rows: int | None = None
    """Number of rows to split into bands on CPU; None: the pass cannot be split."""
    extent: Callable[[], Rows] | None = None
    """Function that returns the rows to process in this frame, called on CPU before splitting; None means all."""
    on_host: bool = False
    """True for work on the host between launches. A captured graph cannot contain it and is cut where it is enabled."""
    enabled: Callable[[], bool] | None = None
    """Predicate for the frames in which the pass runs, called once, after ``Stage.begin``; None means every frame."""
    reads: tuple[str, ...] | None = None
    """Resources that the pass reads; on CUDA it starts when these are written. None means all that the stage reads."""
    beforehand: bool = False
    """True for a host pass that CUDA frames run before all launches, so that the graph needs no cut. Earlier passes
    must not depend on its changes."""


def over_rows(
    rows: int | None, launcher: Callable[..., None], *given: Any, extent: Callable[[], Rows] | None = None, **named: Any
) -> Pass:
    """Return a pass that calls ``launcher(*given, rows=band, **named)`` for bands of ``rows`` rows; None: one call."""
    return Pass(lambda band: launcher(*given, rows=band, **named), rows, extent)


@dataclasses.dataclass(frozen=True)
class Numerics:
    """Expected numerical error of a stage.

    Errors are those of float32 arithmetic only, relative to the output's largest value or in 8-bit codes. The
    approximations of a method (distant emitters, series of order 2) are errors of the cost table instead.
    """

    precision: str
    """Number format of the computation."""
    bound: float
    """Largest error by analysis; tests check it if a float64 twin exists."""
    cause: str
    """Cause of that error."""
    codes: bool = False
    """True if errors are in 8-bit codes."""

    @property
    def expected(self) -> str:
        """Return bound and cause in the form that ``explain`` prints."""
        bound = f"{self.bound:g} codes" if self.codes else f"{self.bound:.0e}"
        return f"{bound}: {self.cause}"


class Arrays(dict[str, Any]):
    """Named arrays of a pipeline. Each has a version, a number that grows whenever its contents change."""

    def __init__(self, constants: dict[Any, Any] | None = None) -> None:
        """Start without arrays; ``constants``, if given, are shared with another pipeline on the same device."""
        super().__init__()
        self._versions: dict[str, int] = {}
        self.constants: dict[Any, Any] = {} if constants is None else constants
        """Tables that are determined by their key and never overwritten."""

    def constant(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the table stored under ``key``; it is made by ``make`` when it is first requested."""
        if key not in self.constants:
            self.constants[key] = make()
        return self.constants[key]

    def add(self, name: str, array: Any) -> None:
        """Add a resource under a new name. Its version starts at 0, which means never written.

        Raises:
            ValueError: The name is taken.
        """
        if name in self:
            raise ValueError(f"resource {name!r} is already there: two stages may not own one resource")
        self[name], self._versions[name] = array, 0

    def touch(self, *names: str) -> None:
        """Increase the versions of resources after a change of their contents."""
        for name in names:
            self._versions[name] += 1

    def version(self, name: str) -> int:
        """Return the version of ``name``; 0 until it is first written."""
        return self._versions[name]


NO_BALL = "the scene has no mirror ball, so the environment is unknown"
NO_OBJECT = "the scene has no virtual object"
NOT_ASKED = "none of its layers is asked for"
"""Reason for which several stages are left out of a plan."""


def unobserved(features: Features) -> str:
    """Return the reason that no mirror ball is read, for a scene without a ball that shows the environment."""
    return NO_BALL if features.request.scene.captured is None else "the environment comes from a file"


class Stage(abc.ABC):
    """Step in the processing of a frame."""

    name: ClassVar[str]
    """Name in reports and in ``Quality``."""
    methods: ClassVar[Mapping[str, str]] = {"default": ""}
    """Methods by name, cheapest first, with a description each."""
    summary: ClassVar[str]
    """Work of the stage, in one line for ``explain``."""
    subject: ClassVar[str] = ""
    """Subject of its methods for tables, if there is a choice."""
    unread: ClassVar[str] = ""
    """Reason that ``explain`` prints if nothing reads its outputs."""
    converges: ClassVar[bool] = False
    """True if all methods approximate the result of the last; False if they are different models."""
    numerics: ClassVar[Numerics]
    """Number format, and expected numerical error of its results."""
    settings: ClassVar[tuple[str, ...]] = ()
    """Settings of ``Quality`` that it shares with other stages and that change its work: ``environment_height``,
    ``edge_samples``, ``light_shadow``."""
    unseen_method: ClassVar[str | None] = None
    """Method for frames that are not shown, for a stage without effect on the light; None: no other method."""
    remembers: ClassVar[tuple[str, ...]] = ()
    """Arrays with state across frames, which a pipeline of another quality takes over."""

    follows: ClassVar[bool] = False
    """True if it must run in every frame because its state accumulates over all of them."""

    def __init__(self, features: Features, wiring: Wiring) -> None:
        self.features, self.wiring = features, wiring
        self.request = features.request
        width, height = self.request.size
        self.height, self.shape = height, (height, width)
        rows = self.request.quality.environment_height
        self.map_height, self.map_shape = rows, (rows, 2 * rows)

    @classmethod
    def method_for(cls, features: Features) -> str:
        """Return the method that runs: the quality's, unless the scene leaves no choice."""
        return features.request.quality.method(cls.name)

    @property
    def method(self) -> str:
        """Method of this stage."""
        return self.method_for(self.features)

    @classmethod
    @abc.abstractmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources that the stage would read and write, or why the scene does not need it.

        The graph itself drops stages whose outputs are not read.
        """

    @abc.abstractmethod
    def arrays(self) -> Mapping[str, ArraySpec]:
        """Return the stage's own arrays: its outputs, and scratch arrays whose names begin with the stage's."""

    @abc.abstractmethod
    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return the passes that process ``arrays``; kernels are compiled when they are first requested here."""

    def begin(self) -> None:  # noqa: B027  (most stages treat all frames alike)
        """Prepare a frame in which the stage runs; called once, before its passes."""

    def host_kernels(self) -> tuple[Any, ...]:
        """Return the kernels that the stage's host passes launch, so that they are compiled in advance."""
        return ()

    def idle(self, reach: Reach) -> str | None:
        """Return the reason if the stage has no effect in a frame; else None.

        Its passes then write the neutral output, whatever their inputs. The result depends on ``reach`` and on inputs
        of the stage only.
        """
        return None

    def reads_for(self, reach: Reach) -> tuple[str, ...]:
        """Return the resources that can affect this frame's output, given ``reach`` and the stage's inputs."""
        return self.wiring.reads

    def rest(self) -> None:  # noqa: B027
        """Prepare a frame in which nothing reads the stage's output; called instead of ``begin``, and no pass runs."""

    def runs_after(self) -> tuple[str, ...]:
        """Return the names of stages that are launched before this one on CUDA although it does not read their output.

        This suits a stage that fills the device by itself, and whose readers wait for those stages anyway.
        """
        return ()

    def close(self) -> None:  # noqa: B027
        """Release resources other than arrays, such as threads."""

    def resume(self, other: Stage) -> None:  # noqa: B027  (most stages remember nothing on the host)
        """Take over the host state of the same stage in another pipeline; its arrays have been copied."""
