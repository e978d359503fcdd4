"""Stage ``recover``: estimates light that clips in the ball from its effect on the card and other surfaces."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels.launch import copy
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery import relocate
from warp_ar.kernels.recovery.light_level import apply_level, follow_level, sum_upward
from warp_ar.kernels.recovery.recover_cells import Cell, add_recovered, cell_shape, condense_cells, leave_out_edges
from warp_ar.kernels.recovery.saturation_boundaries import weigh_boundaries
from warp_ar.kernels.structs import Emitter, struct_dtype
from warp_ar.light import recovery, solving
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.estimate import Estimate
from warp_ar.light.surfaces import find_surfaces
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring, over_rows, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.host_copies import HostCopies
from warp_ar.stages.shared.lighting import trace_variant
from warp_ar.stages.shared.probe_maps import KEPT

EVERY_FRAME = 3
"""Number of frames at a stream's start from each of which an estimate is made, for clips of a few frames."""
EVERY_SECONDS = 0.2
"""Seconds between later estimates, which are at least ``EVERY_FRAME`` frames apart, so that the light follows the
switching of a lamp."""
LATENCY = 0.1
"""Seconds of frame time from the frame that begins an estimate to the frame in which it takes effect, if no frame waits
for the solution at once. The time is fixed, so that equal frames give equal pictures. If the estimate is late by then,
the frame waits; in real time it does not."""
REST = 3.0
"""Least pause between two estimates in real time, divided by the time that the last one took."""
CARD_STEP = 2
"""Stride over the surface points on the printed card, the first in the list, for its observation in every frame."""
WHEN = ("now", "asked", "then")
"""Names of frames in array names: the current one, and those that began the pending and the active estimate."""
MOST_EMITTERS = CONFIG.search.candidates * len(CONFIG.search.distances)


@dataclasses.dataclass
class _Progress:
    """State of the estimates of clipped light on the host, kept from frame to frame."""

    solver: recovery.Recovery
    estimate: Estimate | None = None
    """Estimate in use."""
    pending: Future[_Solved] | None = None
    """Estimate in computation."""
    took: float = 0.0
    """Duration of the last estimate, seconds."""
    frames: int = 0
    waited: int = 0
    """Frames since the last estimate was begun."""
    last: float = 0.0
    """Time at which the last estimate was begun, seconds."""
    failed: str = ""
    """Error of the last estimate; empty if it succeeded."""
    rested: bool = False
    """True if nothing has read the environment since the last estimate."""
    gain: npt.NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.ones(3))
    """Gain of the camera when the last estimate was begun."""


@dataclasses.dataclass(frozen=True)
class _Solved:
    """Result of one estimate."""

    estimate: Estimate | None
    """New estimate; None if the previous one still holds."""
    cells: npt.NDArray[Any]
    """Records of ``Cell`` from which it was made."""
    solver: recovery.Recovery
    """Solver with its state after the estimate."""
    seconds: float
    """Duration of the computation."""


class Recover(Stage):
    """Estimates the radiance that clipped texels of the environment lack, from surfaces that receive the same light.

    It runs after ``fill``: the light on the surfaces depends on the whole environment, including the part behind the
    ball, and filling must not spread an emitter's recovered energy into unseen directions.
    """

    name: ClassVar[str] = "recover"
    methods: ClassVar[Mapping[str, str]] = {
        "clipped": "as the camera saw it",
        "white_card": "scaled to light the white card as the frame shows",
        "shading": "shared among emitters by shading and shadows in the frame",
    }
    summary: ClassVar[str] = "restores clipped light of the ball from the surfaces that it lights"
    subject: ClassVar[str] = "light that clips in the ball"
    unread: ClassVar[str] = "nothing asks for the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        "float32 transfer, float64 solution", 6e-4, "three steps of the search for the mirroring point"
    )
    remembers: ClassVar[tuple[str, ...]] = (
        *("recover_recovered", "recover_cells", "recover_found", "recover_share", "recover_level"),
        *(f"recover_{part}_{when}" for part in ("card", "upward") for when in ("asked", "then")),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with a mirror ball and a method other than ``clipped``."""
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
        """Declare the arrays of the environment map with recovered light, and of the equations for that light."""
        others, shape, most = self.features.others, self.map_shape, (CONFIG.search.most,)
        cells = cell_shape(*shape)
        self._surfaces = find_surfaces(self.request.scene, card_only=self.method == "white_card")
        points, self._card = len(self._surfaces.points), self._card_points()
        specs = {
            "environment": ArraySpec(shape, wp.vec3),
            **{f"recover_card_{when}": ArraySpec((self._card,), kernels.Observation) for when in WHEN},
            **{f"recover_upward_{when}": ArraySpec((3,), wp.float32) for when in WHEN},
            "recover_upward_rows": ArraySpec((self.map_height // 2,), wp.vec3),
            "recover_share": ArraySpec((3,), wp.float32),
            "recover_level": ArraySpec((3,), wp.float32, 1.0),
            "recover_recovered": ArraySpec(cells, wp.vec3),
            "recover_levelled": ArraySpec(cells, wp.vec3),
            "recover_found": ArraySpec(most, Emitter),
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
        }
        if self.features.emitters:
            specs["emitters"] = ArraySpec(most, Emitter)
        if others:  # balls share scratch arrays in turn
            specs["others_environment"] = ArraySpec((others, *shape), wp.vec3)
            specs["recover_others_missing"] = ArraySpec(shape, wp.vec3)
            specs["recover_sent"] = ArraySpec(cells, wp.vec3)
            if self.features.emitters:
                specs["others_emitters"] = ArraySpec((others, *most), Emitter)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes that set up the equations on the device, solve them on the host, and apply the solution."""
        self._proxies = trace_variant(trace_config(self.request.scene), device).proxies
        self._arrays, self._on_cpu = arrays, bool(device.is_cpu)
        arrays["recover_points"].assign(self._surfaces.points)
        self._progress = _Progress(self._new_solver())
        self._asks = self._arrives = self._follows = False
        self._worker: ThreadPoolExecutor | None = None
        arrays.add("recover_status", self.status)

        def copies(*names: str) -> HostCopies:
            return HostCopies({f"recover_{name}": arrays[f"recover_{name}"] for name in names}, device)

        self._looks = copies("cells_now", "observations")
        self._transfers = copies("transfer", "mirrored")
        self._camera = HostCopies({"params": arrays["params"]}, device)
        self._effects = copies("recovered", "cells", "found", "share", "level")
        self._places, self._received = copies("emitters"), copies("emitter_transfer")
        # Separate streams, concurrent with the frames and their capture.
        self._stream: Any = None
        self._frames_stream: Any = None
        if not self._on_cpu:
            self._stream, self._frames_stream = wp.Stream(device), wp.get_stream(device)
        by_card: tuple[Pass, ...] = (
            # The card is in the frame, so it is observed while the map is being unwrapped and filled.
            Pass(self._look_at_card, enabled=lambda: self._asks or self._follows, reads=self.wiring.reads[3:5]),
            Pass(self._sum_upward, enabled=lambda: self._asks or self._follows),
            Pass(self._note_card, enabled=lambda: self._asks),
            Pass(self._follow, enabled=lambda: self._follows),
        )
        by_card = by_card if self._card else ()
        shown = "filled_radiance", "environment_confidence", "recover_missing", "recover_cells", "recover_levelled"
        return [
            Pass(self._take, on_host=True, enabled=lambda: self._arrives, beforehand=True),
            *by_card[:1],
            *self._equations(),
            *by_card[1:3],
            Pass(self._ask, on_host=True, enabled=lambda: self._asks),
            *by_card[3:],
            Pass(self._apply_level),
            over_rows(len(arrays["recover_cells"]), add_recovered, *self._named(*shown, "environment")),
            *(one for ball in range(self.features.others) for one in self._relocate(ball)),
        ]

    def _named(self, *names: str) -> list[Any]:
        """Return the named arrays."""
        return [self._arrays[name] for name in names]

    def _equations(self) -> list[Pass]:
        """Return the passes that find clipped cells and, in frames that begin an estimate, set up the equations."""
        rows, points, proxies = len(self._arrays["recover_cells"]), len(self._surfaces.points), self._proxies
        scene, observed = ("probes", "ray_scene"), ("recover_points", "recover_observations")
        # Clipped texels are known before the map is filled.
        given = self._named("environment_clipped", "params", "probes", "recover_missing")
        passes = [over_rows(self.map_height, weigh_boundaries, *given)]
        if proxies:
            given = self._named("environment_clipped", *scene, "recover_missing")
            passes.append(over_rows(rows, leave_out_edges, proxies, *given))
        shown = "filled_radiance", "environment_confidence", "environment_clipped", "recover_missing"
        transfer = "recover_traced", "recover_transfer", "recover_mirrored"
        given = self._named(*observed, "recover_cells_now", *scene, *transfer)
        asked = [
            over_rows(rows, condense_cells, proxies, *self._named(*shown, *scene, "recover_cells_now")),
            over_rows(points, self._observe, *self._named(*observed)),
            over_rows(points, kernels.trace_transfer, proxies, *given),
        ]
        return [
            *(dataclasses.replace(one, reads=("environment_clipped", "pose")) for one in passes),
            *(dataclasses.replace(one, enabled=lambda: self._asks) for one in asked),
        ]

    def _card_points(self) -> int:
        """Return the number of card points by which the light's level is followed; 0 if it is not followed.

        If the camera has automatic exposure, its gain is estimated from the same points.
        """
        source = self.request.scene.source
        if source is not None and source.metering == "automatic":
            return 0
        kinds = self._surfaces.kinds[self._surfaces.surface]
        return int(np.count_nonzero((kinds == Kind.CARD) | (kinds == Kind.INK))) // CARD_STEP

    def _new_solver(self) -> recovery.Recovery:
        """Return a solver without any learnt state."""
        scene = self.request.scene
        ball = scene.probes[0]
        return recovery.Recovery(
            self._surfaces, scene.marker.white, ball.center, radius=ball.radius, method=self.method
        )

    def _relocate(self, ball: int) -> list[Pass]:
        """Return passes that transfer recovered radiance from the first ball's map to another's, with parallax."""
        arrays, places, height = self._arrays, self._arrays["probe_places"], self.map_height
        emitters = arrays["emitters"] if self.features.emitters else None
        first, out = (arrays["environment"], arrays["filled_radiance"]), arrays["others_environment"][ball]
        filled, missing, sent = arrays["others_filled"][ball], arrays["recover_others_missing"], arrays["recover_sent"]
        clipped, confidence = (arrays[f"{KEPT}_{part}"][ball] for part in ("clipped", "confidence"))
        own = arrays["params"], arrays["probes"][ball + 1 : ball + 2], missing
        found = arrays["recover_cells"], arrays["recover_levelled"]
        cells = found[0]
        known = filled, missing, confidence, *first, emitters, cells, sent
        passes = [
            over_rows(height, weigh_boundaries, clipped, *own),
            over_rows(cells.shape[0], relocate.send_recovered, missing, confidence, *found, sent),
            over_rows(height, relocate.share_recovered, *known, out),
        ]
        if emitters is not None:
            moved = arrays["others_emitters"][ball]
            passes.append(over_rows(height, relocate.relocate, filled, *first, emitters, places, ball + 1, out))
            passes.append(Pass(lambda rows: relocate.move_emitters(emitters, places, moved, ball=ball + 1)))
        return passes

    def _observe(self, points: Any, observations: Any, rows: Rows | None) -> None:
        arrays, linear = self._arrays, "linear_frame" in self.wiring.reads
        frame = arrays["linear_frame" if linear else "frame"], arrays["linear_clip" if linear else "decode"]
        scene = arrays["params"], arrays["probes"], arrays["ray_scene"]
        kernels.observe_surfaces(self._proxies, linear, *frame, *scene, points, observations, rows=rows)

    def _sum_upward(self, rows: Rows | None) -> None:
        sum_upward(*self._named("filled_radiance", "recover_upward_rows", "recover_upward_now"))

    def _look_at_card(self, rows: Rows | None) -> None:
        arrays = self._arrays
        points = arrays["recover_points"][: len(arrays["recover_card_now"]) * CARD_STEP : CARD_STEP]
        self._observe(points, arrays["recover_card_now"], None)

    def _note_card(self, rows: Rows | None) -> None:
        for part in ("card", "upward"):
            copy(self._arrays[f"recover_{part}_asked"], self._arrays[f"recover_{part}_now"])

    def _follow(self, rows: Rows | None) -> None:
        (card, then), upward = (
            [self._arrays[f"recover_{part}_{when}"] for when in ("now", "then")] for part in ("card", "upward")
        )
        follow_level(card, then, upward, self._arrays["recover_share"], self._arrays["recover_level"])

    def _apply_level(self, rows: Rows | None) -> None:
        arrays = self._arrays
        found = arrays["recover_found"] if self.features.emitters else arrays["recover_found"][:0]
        shown = arrays["emitters"] if self.features.emitters else found
        apply_level(arrays["recover_recovered"], found, arrays["recover_level"], arrays["recover_levelled"], shown)

    def host_kernels(self) -> tuple[Any, ...]:
        """Return the solver's kernels: irradiance from emitters at trial positions."""
        return (kernels.make_trace_emitters_kernel(self._proxies),) if self.method == "shading" else ()

    def begin(self) -> None:
        """Decide whether this frame begins an estimate of clipped light, and whether a pending one takes effect."""
        now, seconds, covered = self._progress, self._arrays["seconds"](), self._arrays["ball_covered"]()
        now.frames += 1
        now.waited += 1
        rested, now.rested = now.rested, False
        since, interval = abs(seconds - now.last) + 1e-3, EVERY_SECONDS
        self._arrives = now.pending is not None and since > LATENCY
        if self._real_time:
            self._arrives = self._arrives and now.pending is not None and now.pending.done()
            interval = max(interval, (1.0 + REST) * now.took)
        self._asks = now.frames <= EVERY_FRAME or (since > interval and (rested or now.waited >= EVERY_FRAME))
        if self._real_time:
            # Computed in this process, concurrently with the frames, an estimate would hold Python's lock.
            waits = now.frames > EVERY_FRAME and solving.PROCESS.starting
            self._asks = self._asks and not waits and (now.pending is None or self._arrives)
        self._asks = self._asks and not covered
        if self._asks:
            now.waited, now.last = 0, seconds
        self._follows = self._card > 0 and not covered

    def rest(self) -> None:
        """Prepare a frame in which nothing reads the environment: no estimate of clipped light is begun or applied.

        The first later frame in which ``begin`` is called may begin an estimate without waiting for ``EVERY_FRAME``
        frames.
        """
        self._asks = self._arrives = self._follows = False
        self._progress.rested = True

    def _ask(self, rows: Rows | None) -> None:
        """Begin an estimate from this frame's equations, and apply it at once if this frame must show it."""
        if self._worker is None:
            self._worker = ThreadPoolExecutor(1, "warp_ar-recover")
        for side in (self._looks, self._camera):
            side.fetch(self._stream, self._frames_stream)
        now, waits = self._progress, self.request.estimates == "synchronous"
        now.gain = self._arrays["gain"]()
        at_once = waits or now.frames <= EVERY_FRAME
        # On CUDA and in real time, Python's lock limits the frame rate, and a solution in this process would hold it.
        # On CPU the frames use all cores. The solution is bit-identical in either process.
        background = self._real_time or not (waits or self._on_cpu)
        if background:
            solving.PROCESS.prepare()
        # If a frame waits, a running solver process is used; starting one takes longer than most clips.
        background = solving.PROCESS.ready if waits else background and not at_once
        # On CPU the frame constants are not copied: the next frame overwrites the camera's place during the solution.
        camera = self._camera_place() if self._on_cpu else None
        now.pending = self._worker.submit(self._solve, now.solver, background, camera)
        if at_once:
            self._take(None)

    @property
    def _real_time(self) -> bool:
        """True if frames never wait for an estimate of clipped light."""
        return self.request.estimates == "real_time"

    def _camera_place(self) -> npt.NDArray[np.float64]:
        """Return the camera's position when the equations were set up, metres, (3,)."""
        return np.asarray(self._camera.fetched()["params"]["camera_position"][0], np.float64).copy()

    def _solve(self, solver: recovery.Recovery, background: bool, camera: npt.NDArray[np.float64] | None) -> _Solved:
        """Solve on the worker thread or, if ``background``, in a separate process.

        The equations are not overwritten before this is done: the estimate takes effect before the next one begins.

        Args:
            solver: Solver with its state so far.
            background: True to solve in the separate process.
            camera: Camera position, if it was read already; None: read it from the frame constants.

        Raises:
            LinAlgError: The equations have no solution.
            FloatingPointError: The solution is not finite.
        """
        begin, (cells, observations) = time.perf_counter(), self._looks.fetched().values()
        estimate = None
        if not solver.rests(cells, observations):
            camera = self._camera_place() if camera is None else camera
            self._transfers.fetch(self._stream, self._stream)
            sides = cells, *self._transfers.fetched().values(), observations, camera
            if background:
                solver, estimate = solving.PROCESS.update(solver, sides, self._trace)
            else:
                estimate = solving.update(solver, sides, self._trace)
            if not estimate.is_finite:
                raise FloatingPointError("the solution is not finite")
        return _Solved(estimate, cells, solver, time.perf_counter() - begin)

    def _trace(self, emitters: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Return the irradiance from emitters, (n, q); runs on the worker thread."""
        arrays, count, points = self._arrays, len(emitters), len(self._surfaces.points)
        places = np.zeros((MOST_EMITTERS, 4), np.float32)
        places[:count] = emitters
        self._places.send({"recover_emitters": places}, self._stream)
        kernels.trace_emitters(
            self._proxies,
            arrays["recover_points"],
            arrays["recover_observations"],
            arrays["recover_emitters"][:count],
            arrays["probes"],
            arrays["ray_scene"],
            arrays["recover_emitter_transfer"][: points * count].reshape((points, count)),
            stream=self._stream,
        )
        self._received.fetch(self._stream, self._stream, points * count)
        flat = self._received.fetched()["recover_emitter_transfer"][: points * count]
        return np.array(flat.reshape(points, count), np.float64)

    def _take(self, rows: Rows | None) -> None:
        """Apply the pending estimate; if it failed, keep the light of the previous one and make a new solver."""
        now = self._progress
        assert now.pending is not None
        pending, now.pending, now.failed = now.pending, None, ""
        try:
            solved = pending.result()
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            now.solver, now.failed = self._new_solver(), str(error)
            return
        now.solver, now.took, estimate = solved.solver, solved.seconds, solved.estimate
        if estimate is None:
            return
        now.estimate = estimate
        # The estimate is in camera values of the frame that began it; the camera's gain may have changed since.
        ratio = (self._arrays["gain"]() / now.gain).astype(np.float32)
        records = np.zeros(CONFIG.search.most, struct_dtype(Emitter))
        for record, emitter in zip(records, estimate.emitters, strict=False):
            record["origin"], record["direction"] = emitter.origin, emitter.direction
            record["distance"], record["power"] = emitter.distance, emitter.power * ratio
        values = {
            "recover_recovered": estimate.recovered * ratio,
            "recover_cells": solved.cells,
            "recover_found": records,
            "recover_share": np.array(estimate.card_share, np.float32),
            "recover_level": np.ones(3, np.float32),
        }
        self._effects.send(values)
        for part in ("card", "upward"):
            asked, then = (self._arrays[f"recover_{part}_{when}"] for when in ("asked", "then"))
            if len(then):
                wp.copy(then, asked, stream=self._frames_stream)

    def close(self) -> None:
        """Wait until the worker thread, which uses the pipeline's arrays, has finished."""
        if self._worker is not None:
            self._worker.shutdown()

    def resume(self, other: Stage) -> None:
        """Take over the estimate and the solver's state, unless the method, marker, mirror balls or proxies differ."""
        if not isinstance(other, Recover) or other.method != self.method:
            return
        mine, yours = self.request.scene, other.request.scene
        if (mine.marker, mine.probes, mine.proxies) == (yours.marker, yours.probes, yours.proxies):
            self._progress = dataclasses.replace(other._progress)

    def status(self) -> Mapping[str, Any]:
        """Return the report of the last good estimate, a later one's error text, and any measured ball reflectances."""
        estimate, failed = self._progress.estimate, self._progress.failed
        reason: dict[str, Any] = {"failed": failed} if failed else {}
        told = self._arrays["ball_reflectance"]()
        if told is not None:
            reason["ball_reflectance"] = [[round(value, 3) for value in ball] for ball in told]
        return reason if estimate is None else estimate.report() | reason
