"""Worker of a run: does jobs that read and write files, and returns a record of each."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import hashlib
import shutil
import time
import traceback
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import threadpoolctl

from warp_ar.closing import Closing
from warp_ar.engine.layers import RADIANCE
from warp_ar.errors import WarpArError, causes, reason
from warp_ar.farm.dataset import NoPlace, draw_variation
from warp_ar.farm.frames import mean_rate, shown_ticks
from warp_ar.farm.jobs import (
    AS_RECORDED,
    Context,
    Job,
    Outcome,
    job_of_clip,
    jobs_of_clip,
    lit_range,
    program_version,
    scene_of,
    source_of,
    variations_of,
)
from warp_ar.farm.labels import LAYERS, LabelWriter, write_dataset_files
from warp_ar.farm.lighting import Lighter
from warp_ar.farm.manifest import NO_SPACE, Manifest, aside, publish, publish_files
from warp_ar.farm.survey import lit_scene, survey_clip
from warp_ar.farm.video import join_parts, open_part_sink
from warp_ar.scene import SourceSpec, dumps_scene

PART = "frames.mp4"
"""File with a segment's frames."""
DIGESTS = ".sha256"
"""Suffix of the file of pictures' digests, with one hexadecimal digest per line."""

LEAST_FREE = 1 << 20
"""Number of free bytes below which the disk counts as full, because some libraries report a full disk as another
error."""


class Work(Closing):
    """Worker that does jobs one after another."""

    def __init__(self, context: Context) -> None:
        """Limit the threads of OpenCV and BLAS; no job is begun."""
        cv2.setNumThreads(1)  # more threads do not find a marker sooner, but take more processor time
        threadpoolctl.threadpool_limits(1)  # results of BLAS depend on the number of threads
        self.context = context
        self._lighter = Lighter(context.jobs, context.folder, context.device)

    def close(self) -> None:
        """Close the pipelines."""
        self._lighter.close()

    def version(self) -> str:
        """Return the version of the program."""
        return program_version()

    def do(self, job: Job) -> Outcome:
        """Do a job; an error is returned in the outcome, not raised."""
        context = self.context
        key, start = job.key(context.jobs), time.perf_counter()
        log = context.folder / "log" / f"{key}.log"
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            values = self._do(job)
        except Exception as error:  # any error fails only this job, and its reason is kept
            known = isinstance(error, WarpArError | NoPlace)
            told = str(error) if known else f"{type(error).__name__}: {reason(error)}"
            _note(log, f"failed: {told}", "" if known else traceback.format_exc())
            full = any(getattr(cause, "errno", None) in NO_SPACE for cause in causes(error))
            full = full or _free_bytes(context.folder) < LEAST_FREE
            return Outcome("full" if full else "failed", reason=told)
        finally:
            if job.kind == "survey" or context.jobs.settings.light == "preroll":
                gc.collect()  # the large arrays of the job's own pipeline are part of reference cycles
        seconds = time.perf_counter() - start
        frames = int(values.get("frames", 0))
        _note(log, f"done: {frames} frames in {seconds:.2f} s by worker {context.worker} on {context.device}")
        timing = {"seconds": round(seconds, 3), "ended": round(time.time(), 3), "worker": context.worker}
        return Outcome("done", {**values, **timing})

    def _do(self, job: Job) -> dict[str, Any]:
        context, jobs = self.context, self.context.jobs
        key, place = job.key(jobs), context.folder / job.place(jobs)
        with aside(context.folder, f"{key.replace('/', '.')}.{context.worker}") as part:
            match job.kind:
                case "survey":
                    values = survey_clip(jobs, job.clip, part, context.device)
                case "segment":
                    values = self._light_segment(job, part)
                case "variation":
                    values = self._light_variation(job, part)
                case "join":
                    values = self._join(job, part / place.name)
                    size = publish_files(part, place)
                    shutil.rmtree(context.folder / "parts" / jobs.clips[job.clip].name, ignore_errors=True)
                    return {**values, "bytes": size}
                case _:
                    done = Manifest(context.folder).done
                    found = [job.place(jobs) for job in variations_of(jobs) if job.key(jobs) in done]
                    values = write_dataset_files(jobs, found, part, context.folder, program_version())
                    return {**values, "bytes": publish_files(part, place)}
            return {k: v for k, v in publish(part, place, key, values).items() if k != "job"}

    def _light_segment(self, job: Job, part: Path) -> dict[str, Any]:
        survey = self._lighter.survey(job.clip)
        ticks, tick = shown_ticks(survey.index, source_of(self.context.jobs, job.clip)[1])
        own = self.context.jobs.settings.coding
        coding = survey.coding if own == AS_RECORDED else own
        transfer = str(scene_of(self.context.jobs, job.clip).camera.transfer)
        count = 0
        with contextlib.ExitStack() as stack:
            sink = stack.enter_context(open_part_sink(part / PART, tick, mean_rate(ticks, tick), coding, transfer))
            digests = None
            if self.context.jobs.settings.digests:
                digests = stack.enter_context(open((part / PART).with_suffix(DIGESTS), "w", encoding="ascii"))
            for lit in self._lighter.light(job, outputs=("image",) if coding == "8bit" else (RADIANCE,)):
                picture = lit.image if coding == "8bit" else lit.radiance
                sink.write_at(picture, float(int(ticks[job.first + count] - ticks[job.first]) * tick))
                if digests is not None:
                    digests.write(hashlib.sha256(np.ascontiguousarray(picture).data).hexdigest() + "\n")
                count += 1
        return {"frames": count}

    def _light_variation(self, job: Job, part: Path) -> dict[str, Any]:
        jobs, dataset = self.context.jobs, self.context.jobs.dataset
        assert dataset is not None
        survey = self._lighter.survey(job.clip)
        base = lit_scene(jobs, job.clip, survey)
        base = dataclasses.replace(base, camera=base.camera.scaled_to(*survey.size), source=None)
        poses = [pose for pose in map(survey.pose, range(job.first, job.end, dataset.every)) if pose is not None]
        drawn = draw_variation(base, dataset, job.clip, job.number, poses)
        # The written scene does not name the survey's light, which is in the run's folder and not in the data set.
        path, fps = source_of(jobs, job.clip)
        own = scene_of(jobs, job.clip).captured
        shown = dataclasses.replace(drawn.scene, source=SourceSpec(path=path, fps=fps), captured=own)
        (part / "scene.toml").write_text(dumps_scene(shown), encoding="utf-8")
        with LabelWriter(part, drawn.scene, drawn.kinds, dataset.catalogue) as labels:
            lit_frames = self._lighter.light(job, drawn.scene, outputs=LAYERS, every=dataset.every)
            for lit in lit_frames:
                if lit.result is not None:
                    labels.label(lit, survey.key_of(lit.frame.index) if len(survey.keys) else None)
            return {"frames": labels.finish()}

    def _join(self, job: Job, output: Path) -> dict[str, Any]:
        jobs = self.context.jobs
        survey = self._lighter.survey(job.clip)
        path, fps = source_of(jobs, job.clip)
        ticks, tick = shown_ticks(survey.index, fps)
        first, end = lit_range(jobs.clips[job.clip], survey.index.length)
        segments = [
            job_of_clip(jobs, job.clip, number, survey.index.length)
            for number in range(jobs_of_clip(jobs, job.clip, survey.index.length))
        ]
        count = join_parts(
            [self.context.folder / segment.place(jobs) / PART for segment in segments],
            [int(ticks[segment.first]) for segment in segments],
            tick,
            output,
            recording=path if path.is_file() and fps is None else None,
            zero=int(ticks[first]) if first else 0,
            until=float(int(ticks[end]) * tick) if end < survey.index.length else None,
        )
        if count != end - first:
            raise WarpArError(f"{output.name} has {count} frames, not {end - first}; remove its parts and resume")
        if jobs.settings.digests:
            files = [(self.context.folder / segment.place(jobs) / PART).with_suffix(DIGESTS) for segment in segments]
            output.with_suffix(DIGESTS).write_text("".join(file.read_text("ascii") for file in files), "ascii")
        return {"frames": count}


def _free_bytes(folder: Path) -> int:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return LEAST_FREE


def _note(log: Path, line: str, more: str = "") -> None:
    """Append a line to a job's log; if this fails, for example on a full disk, the job goes on without the line.

    Args:
        log: The file.
        line: The line, before which date and time are written.
        more: Further text after the line.
    """
    with contextlib.suppress(OSError), open(log, "a", encoding="utf-8") as stream:
        stream.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n{more}")
