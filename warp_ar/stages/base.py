"""Stages: what they read and write, the methods they have, and the passes that do their work.

A stage has two lives. While a plan is made, only its class speaks: ``wire`` says, from the request's features alone,
what it would read and write, or why the scene does not call for it. Nothing of Warp is touched then. When a pipeline is
built, ``build`` turns a wired stage into passes over arrays that have been allocated from what ``arrays`` declared.

All that is to be known of a stage stands in its class: its methods with what tables say of them, how precisely it
computes, which settings of ``Quality`` it shares with others. Stages know the features, never each other.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

from warp_ar.stages.features import Features

Rows = tuple[int, int]


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
class Reach:
    """Reach of virtual objects and lights in a frame, known on the host before any stage runs."""

    objects: bool = True
    """A virtual object may be in the picture."""
    shines: bool = True
    """A virtual light has power."""
    falls: bool = True
    """Virtual light may fall on the receiver, in the picture or beside it."""
    light: bool = True
    """Virtual light may fall on the receiver in the picture."""
    shadows: bool = True
    """A virtual object may change the environment on the receiver in the picture."""
    balls: bool = True
    """A mirror ball may be in the picture."""


OUT_OF_PICTURE = "no virtual object is in the picture"
"""Reason of several stages to be idle."""


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
    """Works on the host between launches: it cannot be part of a captured graph, which is cut where it is enabled."""
    enabled: Callable[[], bool] | None = None
    """Predicate of the frames in which the pass takes part, asked once, after ``Stage.begin``; None means always."""
    reads: tuple[str, ...] | None = None
    """Resources of the stage that it reads: on CUDA it begins when these are there. None means all."""
    beforehand: bool = False
    """True for a pass on the host that CUDA frames run before all launches. Earlier passes must not depend on its
    changes; the graph then needs no cut."""


def over_rows(
    rows: int | None, launcher: Callable[..., None], *given: Any, extent: Callable[[], Rows] | None = None, **named: Any
) -> Pass:
    """A pass that splits ``rows`` into bands for a launcher that takes ``rows``; ``given`` are its other arguments."""
    return Pass(lambda band: launcher(*given, rows=band, **named), rows, extent)


@dataclasses.dataclass(frozen=True)
class Numerics:
    """Expected numerical error of a stage.

    Errors are those of float32 arithmetic alone, over the largest value of the output, or in 8-bit codes: what a method
    leaves out (the distance of an emitter, the lobes of an order-2 series) is the cost table's matter.
    """

    precision: str
    """Number format of the computation."""
    bound: float
    """Worst error by analysis; tests check it wherever a float64 twin exists."""
    cause: str
    """Cause of that error."""
    measured: float
    """Worst error against a float64 twin on CPU; in a checkout ``python -m tests.hard_cases.measure_errors`` measures
    it anew."""
    rows: tuple[int, ...]
    """Rows of the atlas of hard cases that concern it."""
    codes: bool = False
    """True if errors are in 8-bit codes."""

    @property
    def expected(self) -> str:
        """Bound and cause, as ``explain`` prints them."""
        bound = f"{self.bound:g} codes" if self.codes else f"{self.bound:.0e}"
        return f"{bound}: {self.cause}"


class Arrays(dict[str, Any]):
    """The named arrays of a pipeline, with a version each: a number that grows whenever the contents change."""

    def __init__(self, constants: dict[Any, Any] | None = None) -> None:
        """Begin empty, but for the ``constants`` of another pipeline of the device."""
        super().__init__()
        self._versions: dict[str, int] = {}
        self.constants: dict[Any, Any] = {} if constants is None else constants
        """Tables that nothing but their key decides, and that nobody writes again."""

    def constant(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the table of a key, made where it is not there."""
        if key not in self.constants:
            self.constants[key] = make()
        return self.constants[key]

    def add(self, name: str, array: Any) -> None:
        """Add a resource under a new name; its version starts at 0, which means never written.

        Raises:
            ValueError: There is one of that name.
        """
        if name in self:
            raise ValueError(f"resource {name!r} is already there: two stages may not own one resource")
        self[name], self._versions[name] = array, 0

    def touch(self, name: str) -> None:
        """Say that the contents of ``name`` changed."""
        self._versions[name] += 1

    def touch_all(self, names: Iterable[str]) -> None:
        """The same of several."""
        for name in names:
            self._versions[name] += 1

    def version(self, name: str) -> int:
        """Version of ``name``: 0 until it is first written."""
        return self._versions[name]

    def versions_of(self, names: Sequence[str]) -> Callable[[], Any]:
        """Return a function of the versions of several, in a form that is only compared; it is asked in every frame."""
        return functools.partial(operator.itemgetter(*names), self._versions) if names else tuple


NO_BALL = "the scene has no mirror ball, so the environment is unknown"
NO_OBJECT = "the scene has no virtual object"
NOT_ASKED = "none of its layers is asked for"
"""Reasons that several stages give."""


def unobserved(features: Features) -> str:
    """Why nothing is read off a mirror ball, where no ball shows the environment."""
    return NO_BALL if features.request.scene.captured is None else "the environment comes from a file"


class Stage(abc.ABC):
    """One step on the way of a frame."""

    name: ClassVar[str]
    """Name in reports and in ``Quality``."""
    methods: ClassVar[Mapping[str, str]] = {"default": ""}
    """Methods by name, cheapest first, with a description each."""
    summary: ClassVar[str]
    """Work of the stage, in one line for ``explain``."""
    subject: ClassVar[str] = ""
    """Subject of its methods, for tables; only where there is a choice."""
    unread: ClassVar[str] = ""
    """Reason for ``explain`` when nothing reads its outputs."""
    converges: ClassVar[bool] = False
    """True if all methods approximate the last one's result; False if they are different models."""
    numerics: ClassVar[Numerics]
    """Precision of its results."""
    settings: ClassVar[tuple[str, ...]] = ()
    """Settings of ``Quality`` that it shares with other stages and that change its work: ``environment_height``,
    ``edge_samples``, ``light_shadow``."""
    unseen_method: ClassVar[str | None] = None
    """Method for frames that are not shown, if the stage does not affect the light; None for no change."""
    remembers: ClassVar[tuple[str, ...]] = ()
    """Arrays with state across frames, which a pipeline of another quality takes over."""

    follows: ClassVar[bool] = False
    """True if it must run in every frame because its state accumulates over all of them."""

    def __init__(self, features: Features, wiring: Wiring) -> None:
        self.features, self.wiring = features, wiring
        self.request = features.request
        width, height = self.request.size
        self.height, self.shape = height, (height, width)

    @classmethod
    def method_for(cls, features: Features) -> str:
        """Method on which the stage runs: the quality's, unless the scene leaves no choice."""
        return features.request.quality.method(cls.name)

    @property
    def method(self) -> str:
        """Method of this stage."""
        return self.method_for(self.features)

    @classmethod
    @abc.abstractmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Say what the stage would read and write, or why the scene does not call for it.

        Whether anything reads what it writes is not asked here: a stage that nothing reads is dropped from the plan.
        """

    @abc.abstractmethod
    def arrays(self) -> Mapping[str, ArraySpec]:
        """Arrays that the stage owns: all that it writes, and its scratch space under names that begin with its own."""

    @abc.abstractmethod
    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Passes that do the work on ``arrays``; compiles what it needs by asking for its kernels."""

    def begin(self) -> None:  # noqa: B027  (most stages treat all frames alike)
        """Called once in every frame in which the stage runs, before any of its passes."""

    def host_kernels(self) -> tuple[Any, ...]:
        """Return kernels launched by its steps on the host, to compile them with the others."""
        return ()

    def idle(self, reach: Reach) -> str | None:
        """Return the reason if the stage has no effect in a frame; else None.

        Its passes then write just that, whatever the stage reads. What it says may change only when something that it
        reads does, and is the same for the same ``reach``.
        """
        return None

    def reads_for(self, reach: Reach) -> tuple[str, ...]:
        """Return the inputs that can affect this frame's output, like ``idle``."""
        return self.wiring.reads

    def rest(self) -> None:  # noqa: B027
        """Called instead of ``begin`` in a frame in which nothing reads what the stage writes."""

    def runs_after(self) -> tuple[str, ...]:
        """Names of stages that are launched before this one on CUDA, though it reads nothing of theirs.

        For a stage that nobody waits for before those are done, and that fills the device by itself.
        """
        return ()

    def close(self) -> None:  # noqa: B027
        """Let go of what the stage holds beside arrays: its threads."""

    def changed(self, name: str) -> bool:
        """Return whether the last run changed the written resource ``name`` enough for its readers to run again."""
        return True

    def resume(self, other: Stage) -> None:  # noqa: B027  (most stages remember nothing on the host)
        """Take over what the same stage of another pipeline remembers on the host; its arrays have been copied."""
