"""Light that clipping lost in the ball is put back, by what the card and other surfaces show of it."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels.environment import change
from warp_ar.kernels.launch import copy
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery import relocate
from warp_ar.kernels.recovery.light_level import apply_level, follow_level, sum_upward
from warp_ar.kernels.recovery.recover_cells import Cell, add_recovered, cell_shape, condense_cells, leave_out_edges
from warp_ar.kernels.recovery.saturation_boundaries import weigh_boundaries
from warp_ar.kernels.structs import Emitter
from warp_ar.light import recovery
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.estimate import Estimate
from warp_ar.light.solving_process import POOL, solve_by
from warp_ar.light.surfaces import find_surfaces
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.host_copies import HostCopies
from warp_ar.stages.shared.lighting import trace_variant
from warp_ar.stages.shared.probe_maps import KEPT

EVERY_FRAME = 3
"""Frames at a stream's start that are each estimated from: clips of a few frames get all that recovery can do."""
EVERY_SECONDS = 0.2
"""Between estimates after that, and no fewer than ``EVERY_FRAME`` frames: light follows as fast as a switched
emitter."""
LATENCY = 0.1
"""Seconds, by the frames' clock, after which an estimate takes effect, unless the request is to wait for it: it is
solved for beside them. They are fixed, so that the same frames give the same pictures; where it is not solved for in
time, the frame waits, unless the request is for real time."""
REST = 3.0
"""In real time: time between two estimates, over that which the last one took, at least."""
CARD_STEP = 2
"""One of so many of the card's points, which come first, is looked at in each frame."""
WHEN = ("now", "asked", "then")
"""In the frame; in the one that the estimate which is being solved for is of; in that of the one in effect."""
MOST_EMITTERS = CONFIG.search.candidates * len(CONFIG.search.distances)


@dataclasses.dataclass
class _Progress:
    """What is known on the host, from frame to frame."""

    solver: recovery.Recovery
    estimate: Estimate | None = None
    """The one that took effect last."""
    pending: Future[_Solved] | None = None
    """The one that is being solved for."""
    took: float = 0.0
    """Seconds of the last one."""
    frames: int = 0
    waited: int = 0
    """Frames since the last estimate was begun."""
    last: float = 0.0
    """When that was, seconds."""
    failed: str = ""
    """Why the last one could not be solved for; empty where it could."""
    rested: bool = False
    """Whether nothing has read the environment since."""
    gain: npt.NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.ones(3))
    """Of the camera when the last estimate was begun."""


@dataclasses.dataclass(frozen=True)
class _Solution:
    estimate: Estimate
    cells: npt.NDArray[Any]
    """What it was estimated from: records of ``Cell``."""


@dataclasses.dataclass(frozen=True)
class _Solved:
    solution: _Solution | None
    """None where the last still holds."""
    solver: recovery.Recovery
    """With what it learnt."""
    seconds: float
    """What it took."""


class Recover(Stage):
    """Estimates what clipped texels lack from surfaces that the same light falls on.

    It comes after filling, not before: what the surfaces receive depends on the whole environment, the part behind the
    ball included, and an emitter's recovered energy must not be spread into the unseen by filling.
    """

    name: ClassVar[str] = "recover"
    methods: ClassVar[Mapping[str, str]] = {
        "clipped": "as the camera saw it (the paper)",
        "white_card": "scaled until it lights the white card as brightly as the frame shows",
        "shading": "shared among emitters as shading and shadows in the frame tell",
    }
    summary: ClassVar[str] = "puts back the light that clipping lost in the ball, by what it falls on"
    subject: ClassVar[str] = "light that clips in the ball"
    unread: ClassVar[str] = "nothing asks for the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32 transfer, float64 solution",
        bound=6e-4,
        cause="three steps of the search for the mirroring point",
        measured=0.00016,
        rows=(1, 3, 4, 5, 6, 7, 12, 13, 14, 17, 18),
    )
    remembers: ClassVar[tuple[str, ...]] = (
        *("recover_recovered", "recover_cells", "recover_found", "recover_share", "recover_level"),
        *(f"recover_{part}_{when}" for part in ("card", "upward") for when in ("asked", "then")),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Needs a mirror ball and a method that does something."""
        if not features.observed:
            return LeftOut(unobserved(features))
        if not features.recovered:
            return LeftOut("the quality takes the light as the camera clipped it")
        seen = "linear_frame" if features.request.linear else "frame"
        reads = "filled_radiance", "environment_confidence", "environment_clipped", seen, "pose"
        writes = ("environment", "emitters") if features.emitters else ("environment",)
        if not features.others:
            return Wiring(reads, writes)
        others = ("others_environment", "others_emitters") if features.emitters else ("others_environment",)
        kept = [f"{KEPT}_{part}" for part in ("confidence", "clipped")]
        return Wiring((*reads, "others_filled", *kept, "probe_places"), (*writes, *others))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The map, the two sides of the equations, and what readers have seen."""
        height = self.request.quality.environment_height
        shape = (height, 2 * height)
        cells = cell_shape(*shape)
        self._surfaces = find_surfaces(self.request.scene, card_only=self.method == "white_card")
        points, self._card = len(self._surfaces.points), self._card_points()
        others = self.features.others
        types: dict[str, tuple[tuple[int, ...], Any]] = {"others_environment": (shape, wp.vec3)}
        types["others_emitters"] = (CONFIG.search.most,), Emitter
        # Balls take turns with these.
        missing = {"recover_others_missing": ArraySpec(shape, wp.vec3), "recover_sent": ArraySpec(cells, wp.vec3)}
        return {
            **(missing if others else {}),
            **{
                name: ArraySpec((others, *types[name][0]), types[name][1])
                for name in self.wiring.writes
                if name in types
            },
            "environment": ArraySpec(shape, wp.vec3),
            **{name: ArraySpec((CONFIG.search.most,), Emitter) for name in self.wiring.writes if name == "emitters"},
            **{f"recover_card_{when}": ArraySpec((self._card,), kernels.Observation) for when in WHEN},
            **{f"recover_upward_{when}": ArraySpec((3,), wp.float32) for when in WHEN},
            "recover_upward_rows": ArraySpec((height // 2,), wp.vec3),
            "recover_share": ArraySpec((3,), wp.float32),
            "recover_level": ArraySpec((3,), wp.float32, 1.0),
            "recover_recovered": ArraySpec(cells, wp.vec3),
            "recover_found": ArraySpec((CONFIG.search.most,), Emitter),
            **({"recover_levelled": ArraySpec(cells, wp.vec3)} if self._card else {}),
            "recover_missing": ArraySpec(shape, wp.vec3),
            "recover_cells": ArraySpec(cells, Cell),
            "recover_cells_now": ArraySpec(cells, Cell),
            "recover_points": ArraySpec((points,), kernels.SurfacePoint),
            "recover_observations": ArraySpec((points,), kernels.Observation),
            "recover_traced": ArraySpec((points,), wp.int32),
            "recover_transfer": ArraySpec((points, cells[0] * cells[1]), wp.float32),
            "recover_mirrored": ArraySpec((points, cells[0] * cells[1]), wp.float32),
            "recover_emitters": ArraySpec((MOST_EMITTERS,), wp.vec4),
            "recover_emitter_transfer": ArraySpec((points * MOST_EMITTERS,), wp.float32),
            "recover_published": ArraySpec(shape, wp.vec3),
            "recover_difference": ArraySpec((height,), wp.float32),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Both sides of the equations on the device, their solution on the host beside it, its effect on the map."""
        self._proxies = trace_variant(trace_config(self.request.scene), device).proxies
        self._arrays, self._device = arrays, device
        arrays["recover_points"].assign(self._surfaces.points)
        self._progress = _Progress(self._new_solver())
        self._asks = self._arrives = self._news = self._follows = False
        self._worker: ThreadPoolExecutor | None = None
        points = len(self._surfaces.points)
        arrays.add("recover_status", self.status)
        equations = ("recover_cells_now", "recover_transfer", "recover_mirrored", "recover_observations", "params")
        effects = ("recover_recovered", "recover_cells", "recover_found", "recover_share", "recover_level")
        self._equations = HostCopies({name: arrays[name] for name in equations}, device)
        self._effects = HostCopies({name: arrays[name] for name in effects}, device)
        sides = {name: arrays[name] for name in ("recover_emitters", "recover_emitter_transfer")}
        self._emitters = {name: HostCopies({name: array}, device) for name, array in sides.items()}
        # Streams of its own: beside frames, and beside their capture.
        self._stream = None if device.is_cpu else wp.Stream(device)
        self._frames_stream = None if device.is_cpu else wp.get_stream(device)

        looks = (
            Pass(self._look_at_card, enabled=lambda: self._asks or self._follows),
            Pass(self._note_card, enabled=lambda: self._asks),
            Pass(self._follow, enabled=lambda: self._follows),
        )
        passes = [
            Pass(self._take, on_host=True, enabled=lambda: self._arrives, beforehand=True),
            # What clips is known before the map is filled.
            Pass(self._weigh, rows=self.request.quality.environment_height, reads=("environment_clipped", "pose")),
            *((Pass(self._leave_out, rows=arrays["recover_cells_now"].shape[0]),) if self._proxies else ()),
            Pass(self._condense, rows=arrays["recover_cells_now"].shape[0], enabled=lambda: self._asks),
            Pass(self._observe, rows=points, enabled=lambda: self._asks),
            Pass(self._transfer, rows=points, enabled=lambda: self._asks),
            *(looks[:2] if self._card else ()),
            Pass(self._ask, on_host=True, enabled=lambda: self._asks),
            *(looks[2:] if self._card else ()),
            *self._levelling(),
            Pass(self._add, rows=arrays["recover_cells"].shape[0]),
        ]
        passes += [one for ball in range(self.features.others) for one in self._relocate(ball)]
        if device.is_cpu:
            passes.append(Pass(self._measure, rows=self.request.quality.environment_height))
        return passes

    def _card_points(self) -> int:
        """Number of points by which the light's level is followed, on the card; 0 where it is not.

        Where a camera meters by itself its own gain is told by the same points.
        """
        source = self.request.scene.source
        if source is not None and source.metering == "automatic":
            return 0
        kinds = self._surfaces.kinds[self._surfaces.surface]
        return int(np.count_nonzero((kinds == Kind.CARD) | (kinds == Kind.INK))) // CARD_STEP

    def _new_solver(self) -> recovery.Recovery:
        """One that has learnt nothing yet."""
        scene = self.request.scene
        ball = scene.probes[0]
        return recovery.Recovery(
            self._surfaces, scene.marker.white, ball.center, radius=ball.radius, method=self.method
        )

    @property
    def _levelled(self) -> str:
        """Name of what cells lack: at the level that the card shows now, or as estimated where none is followed."""
        return "recover_levelled" if self._card else "recover_recovered"

    def _levelling(self) -> tuple[Pass, ...]:
        """What an estimate found, at the level that it has now; its emitters alone where no level is followed."""
        if self._card:
            return (Pass(self._apply_level),)
        return (Pass(self._show_emitters),) if "emitters" in self.wiring.writes else ()

    def _relocate(self, ball: int) -> list[Pass]:
        """What was recovered in the first ball's map, put into that of another as it sees it."""
        arrays, places, height = self._arrays, self._arrays["probe_places"], self.request.quality.environment_height
        emitters = arrays["emitters"] if self.features.emitters else None
        first, out = (arrays["environment"], arrays["filled_radiance"]), arrays["others_environment"][ball]
        filled, missing, sent = arrays["others_filled"][ball], arrays["recover_others_missing"], arrays["recover_sent"]
        clipped, confidence = (arrays[f"{KEPT}_{part}"][ball] for part in ("clipped", "confidence"))
        own = arrays["params"], arrays["probes"][ball + 1 : ball + 2], missing
        found = arrays["recover_cells"], arrays[self._levelled]
        other, cells = (filled, missing, confidence), found[0]
        send = functools.partial(relocate.send_recovered, missing, confidence, *found, sent)
        share = functools.partial(relocate.share_recovered, other, *first, emitters, cells, sent, out)
        passes = [
            Pass(lambda rows: weigh_boundaries(clipped, *own, rows=rows), rows=height),
            Pass(lambda rows: send(rows=rows), rows=cells.shape[0]),
            Pass(lambda rows: share(rows=rows), rows=height),
        ]
        if emitters is not None:
            moved = arrays["others_emitters"][ball]
            put = functools.partial(relocate.relocate, filled, *first, emitters, places, out, ball=ball + 1)
            passes.append(Pass(lambda rows: put(rows=rows), rows=height))
            passes.append(Pass(lambda rows: relocate.move_emitters(emitters, places, moved, ball=ball + 1)))
        return passes

    def _weigh(self, rows: Rows | None) -> None:
        arrays = self._arrays
        weigh_boundaries(
            arrays["environment_clipped"], arrays["params"], arrays["probes"], arrays["recover_missing"], rows=rows
        )

    def _leave_out(self, rows: Rows | None) -> None:
        arrays = self._arrays
        leave_out_edges(
            arrays["environment_clipped"],
            arrays["probes"],
            arrays["ray_scene"],
            arrays["recover_missing"],
            proxies=self._proxies,
            rows=rows,
        )

    def _condense(self, rows: Rows | None) -> None:
        arrays = self._arrays
        condense_cells(
            arrays["filled_radiance"],
            arrays["environment_confidence"],
            arrays["environment_clipped"],
            arrays["recover_missing"],
            arrays["probes"],
            arrays["ray_scene"],
            arrays["recover_cells_now"],
            proxies=self._proxies,
            rows=rows,
        )

    def _observe(self, rows: Rows | None) -> None:
        self._observe_points(self._arrays["recover_points"], self._arrays["recover_observations"], rows)

    def _look_at_card(self, rows: Rows | None) -> None:
        arrays = self._arrays
        sum_upward(arrays["filled_radiance"], arrays["recover_upward_rows"], arrays["recover_upward_now"])
        points = arrays["recover_points"][: len(arrays["recover_card_now"]) * CARD_STEP : CARD_STEP]
        self._observe_points(points, arrays["recover_card_now"], None)

    def _note_card(self, rows: Rows | None) -> None:
        for part in ("card", "upward"):
            copy(self._arrays[f"recover_{part}_asked"], self._arrays[f"recover_{part}_now"])

    def _follow(self, rows: Rows | None) -> None:
        arrays = self._arrays
        follow_level(
            arrays["recover_card_now"],
            arrays["recover_card_then"],
            (arrays["recover_upward_now"], arrays["recover_upward_then"]),
            arrays["recover_share"],
            arrays["recover_level"],
        )

    def _apply_level(self, rows: Rows | None) -> None:
        arrays = self._arrays
        found = arrays["recover_found"] if "emitters" in self.wiring.writes else arrays["recover_found"][:0]
        shown = arrays["emitters"] if "emitters" in self.wiring.writes else found
        apply_level(arrays["recover_recovered"], found, arrays["recover_level"], arrays["recover_levelled"], shown)

    def _show_emitters(self, rows: Rows | None) -> None:
        copy(self._arrays["emitters"], self._arrays["recover_found"])

    def _observe_points(self, points: Any, observations: Any, rows: Rows | None) -> None:
        arrays, linear = self._arrays, "linear_frame" in self.wiring.reads
        kernels.observe_surfaces(
            arrays["linear_frame" if linear else "frame"],
            arrays["linear_clip" if linear else "decode"],
            arrays["params"],
            arrays["probes"],
            arrays["ray_scene"],
            points,
            observations,
            proxies=self._proxies,
            rows=rows,
        )

    def _transfer(self, rows: Rows | None) -> None:
        arrays = self._arrays
        kernels.trace_transfer(
            arrays["recover_points"],
            arrays["recover_observations"],
            arrays["recover_cells_now"],
            arrays["probes"],
            arrays["ray_scene"],
            arrays["recover_traced"],
            arrays["recover_transfer"],
            arrays["recover_mirrored"],
            proxies=self._proxies,
            rows=rows,
        )

    def _add(self, rows: Rows | None) -> None:
        arrays = self._arrays
        add_recovered(
            arrays["filled_radiance"],
            arrays["environment_confidence"],
            arrays["recover_missing"],
            arrays["recover_cells"],
            arrays[self._levelled],
            arrays["environment"],
            rows=rows,
        )

    def _measure(self, rows: Rows | None) -> None:
        arrays = self._arrays
        change.measure_difference(
            arrays["environment"], arrays["recover_published"], arrays["recover_difference"], rows=rows
        )

    def host_kernels(self) -> tuple[Any, ...]:
        """Of the solver: irradiance from emitters, at whatever places it tries."""
        return (kernels.make_trace_emitters_kernel(self._proxies),) if self.method == "shading" else ()

    def begin(self) -> None:
        """Decide whether an estimate is begun in this frame, and whether one takes effect."""
        now, seconds = self._progress, self._arrays["seconds"]()
        now.frames += 1
        now.waited += 1
        rested, now.rested = now.rested, False
        since = abs(seconds - now.last) + 1e-3
        self._arrives = now.pending is not None and since > LATENCY
        interval = EVERY_SECONDS
        if self._real_time:
            self._arrives = self._arrives and now.pending is not None and now.pending.done()
            interval = max(interval, (1.0 + REST) * now.took)
        self._asks = now.frames <= EVERY_FRAME or (since > interval and (rested or now.waited >= EVERY_FRAME))
        if self._real_time and now.pending is not None and not self._arrives:
            self._asks = False
        if self._real_time and self._asks and now.frames > EVERY_FRAME and POOL.starting:
            self._asks = False  # solved for here, beside the frames, it would hold the interpreter's lock
        self._asks = self._asks and not self._arrays["ball_covered"]()
        if self._asks:
            now.waited, now.last = 0, seconds
        self._follows = self._card > 0 and not self._arrays["ball_covered"]()

    def rest(self) -> None:
        """No estimate is begun or takes effect; the first frame that needs one begins it at once."""
        self._asks = self._arrives = self._follows = False
        self._progress.rested = True

    def _ask(self, rows: Rows | None) -> None:
        """Begin to solve, and wait for it where it takes effect at once."""
        if self._worker is None:
            self._worker = ThreadPoolExecutor(1, "warp_ar-recover")
        self._equations.fetch(self._stream, self._frames_stream)
        now = self._progress
        now.gain = self._arrays["gain"]()
        now.solver.gain = np.array(now.gain, float)
        if self._has_process:
            POOL.prepare()
        # In this process a solution holds the interpreter's lock, which frames beside it wait for. Where a frame waits
        # for it, a process that is there already is used; to start one takes longer than most clips.
        aside = POOL.ready if self._waits else self._has_process and not self._at_once()
        # On CPU the frame's values are no copy: the next frame writes where the camera is, beside the worker.
        camera = _camera_of(self._equations.fetched()) if self._device.is_cpu else None
        now.pending = self._worker.submit(self._solve, now.solver, aside, camera)
        if self._at_once():
            self._take(None)

    @property
    def _real_time(self) -> bool:
        """Whether no frame waits for an estimate."""
        return self.request.estimates == "real_time"

    @property
    def _has_process(self) -> bool:
        """Whether estimates after a stream's first are solved for in a process beside this one.

        On CUDA frames are bound by the interpreter's lock. On CPU frames take all cores, and a process would have to
        take one from them. What it finds is the same to the bit.
        """
        return self._real_time or not (self._waits or self._device.is_cpu)

    @property
    def _waits(self) -> bool:
        """Whether every frame waits for its estimate."""
        return self.request.estimates == "synchronous"

    def _at_once(self) -> bool:
        """Whether this frame's estimate, if it begins one, takes effect in it: a stream's first do."""
        return self._waits or self._progress.frames <= EVERY_FRAME

    def _solve(self, solver: recovery.Recovery, aside: bool, camera: npt.NDArray[np.float64] | None) -> _Solved:
        """In the worker, or, if ``aside``, in a process beside it; ``camera`` is where it stands, if that is known.

        Nothing writes the equations before this is done: it takes effect before the next begins.

        Raises:
            LinAlgError: The equations have no solution.
            FloatingPointError: It is not finite.
        """
        begin, sides = time.perf_counter(), self._equations.fetched()
        cells = sides["recover_cells_now"]
        given = (
            cells,
            sides["recover_transfer"],
            sides["recover_mirrored"],
            sides["recover_observations"],
            _camera_of(sides) if camera is None else camera,
        )
        if aside:
            solver, estimate = POOL.solve(solver, given, self._trace)
        else:
            estimate = solve_by(solver, given, self._trace)
        if estimate is not None and not _is_finite(estimate):
            raise FloatingPointError("the solution is not finite")
        solution = None if estimate is None else _Solution(estimate, cells)
        return _Solved(solution, solver, time.perf_counter() - begin)

    def _trace(self, emitters: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Irradiance from emitters, (n, q); in the worker."""
        arrays, count, points = self._arrays, len(emitters), len(self._surfaces.points)
        places = np.zeros((MOST_EMITTERS, 4), np.float32)
        places[:count] = emitters
        self._emitters["recover_emitters"].send({"recover_emitters": places}, self._stream)
        target = arrays["recover_emitter_transfer"][: points * count].reshape((points, count))
        kernels.trace_emitters(
            arrays["recover_points"],
            arrays["recover_observations"],
            arrays["recover_emitters"][:count],
            arrays["probes"],
            arrays["ray_scene"],
            target,
            proxies=self._proxies,
            stream=self._stream,
        )
        received = self._emitters["recover_emitter_transfer"]
        received.fetch(self._stream, self._stream, points * count)
        flat = received.fetched()["recover_emitter_transfer"][: points * count]
        return np.array(flat.reshape(points, count), np.float64)

    def _take(self, rows: Rows | None) -> None:
        """Let what was solved for take effect; where that has failed, the light stays, and the solver begins anew."""
        now, self._news = self._progress, False
        assert now.pending is not None
        pending, now.pending, now.failed = now.pending, None, ""
        try:
            solved = pending.result()
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            now.solver, now.failed = self._new_solver(), str(error)
            return
        now.solver, now.took = solved.solver, solved.seconds
        solution = solved.solution
        self._news = solution is not None
        if solution is None:
            return
        now.estimate = solution.estimate
        # In camera values of the frame that it was begun in; the camera's gain may have changed since.
        ratio = (self._arrays["gain"]() / now.gain).astype(np.float32)
        recovered = solution.estimate.recovered * ratio
        records = np.zeros(CONFIG.search.most, np.dtype(Emitter.numpy_dtype()))
        for record, emitter in zip(records, solution.estimate.emitters, strict=False):
            record["origin"], record["direction"] = emitter.origin, emitter.direction
            record["distance"], record["power"] = emitter.distance, emitter.power * ratio
        values = {"recover_recovered": recovered, "recover_cells": solution.cells, "recover_found": records}
        values |= {
            "recover_share": np.array(solution.estimate.card_share, np.float32),
            "recover_level": np.ones(3, np.float32),
        }
        self._effects.send(values, self._frames_stream)
        for part in ("card", "upward"):
            asked, then = (self._arrays[f"recover_{part}_{when}"] for when in ("asked", "then"))
            if len(then):
                wp.copy(then, asked, stream=self._frames_stream)

    def close(self) -> None:
        """See the worker end: what it solves, the arrays that go now are its, and another stage may wait for it."""
        if self._worker is not None:
            self._worker.shutdown()

    def resume(self, other: Stage) -> None:
        """Keep the emitters that were found, and when; on another method, or on another receiver, look anew."""
        if not isinstance(other, Recover) or other.method != self.method:
            return
        mine, yours = self.request.scene, other.request.scene
        if (mine.marker, mine.probes, mine.proxies) == (yours.marker, yours.probes, yours.proxies):
            self._progress = dataclasses.replace(other._progress)

    def changed(self, name: str) -> bool:
        """As ``Fill.changed``; emitters change where an estimate takes effect."""
        if name.startswith("others_"):
            return True
        if name == "emitters":
            return self._news and (self._arrives or (self._asks and self._at_once()))
        if not self._device.is_cpu:
            return True
        if not self._arrays["recover_difference"].numpy().max() > 1.0:
            return False
        wp.copy(self._arrays["recover_published"], self._arrays["environment"])
        return True

    def status(self) -> Mapping[str, Any]:
        """What the last estimate rests on, for reports, and why none was made since; see ``_take``."""
        estimate, failed = self._progress.estimate, self._progress.failed
        reason: dict[str, Any] = {"failed": failed} if failed else {}
        told = self._arrays["ball_reflectance"]()
        if told is not None:
            reason["ball_reflectance"] = [[round(value, 3) for value in ball] for ball in told]
        if estimate is None:
            return reason
        emitters = [
            {
                "direction": [round(float(x), 4) for x in emitter.direction],
                "distance": round(emitter.distance, 3) if np.isfinite(emitter.distance) else None,
                "power": [round(float(x), 4) for x in emitter.power],
            }
            for emitter in estimate.emitters
        ]
        report: dict[str, Any] = {
            "method": estimate.method,
            "factor": round(estimate.factor, 3),
            "card_contrast": round(estimate.card.contrast, 2),
            "lower_bound": list(estimate.lower_bound),
            "emitters": emitters,
        }
        if estimate.irradiance is not None:
            for name in ("low", "value", "high"):
                axes = getattr(estimate.irradiance, name)
                report[f"irradiance_{name}"] = [[round(float(x), 4) for x in axis] for axis in axes]
        return report | reason


def _camera_of(sides: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    """Where the camera stood when the equations were written, metres, (3,)."""
    return np.asarray(sides["params"]["camera_position"][0], np.float64).copy()


def _is_finite(estimate: Estimate) -> bool:
    """Whether all that an estimate puts into the map is a number."""
    powers = all(bool(np.isfinite(emitter.power).all()) for emitter in estimate.emitters)
    return powers and bool(np.isfinite(estimate.recovered).all())
