"""Job files, and their jobs.

A clip is a recording to be lit. A job is a survey of a clip, a segment (consecutive frames of a clip) or a variation (a
clip with randomly drawn objects and lights), or it joins finished outputs. A job names files; frames stay in the worker
that decodes them. Jobs are not listed but computed from their numbers when they are assigned, so that 100,000 of them
take no memory. Their number is known after the clip's survey.
"""

from __future__ import annotations

import dataclasses
import functools
import glob
import hashlib
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import warp_ar
from warp_ar.errors import SceneError
from warp_ar.farm.dataset import Dataset, JobsError, JobTable, read_dataset
from warp_ar.files import is_file, is_folder, parse_toml, read_text
from warp_ar.output.encoders import CODINGS
from warp_ar.scene import CapturedLight, Scene, load_calibration, load_scene
from warp_ar.scene.fields import Key, fields_of
from warp_ar.signature import installed_version
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS

SCHEMA = 1
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
AS_RECORDED = "recorded"
"""Value of the key ``coding`` besides ``CODINGS``: the output has the bit depth of the source."""
_CLIP_KEYS = ("name", "scene", "path", "light", "calibration", "frames")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of all clips."""

    quality: Annotated[str, Key(words=tuple(PRESETS))] = DEFAULT_PRESET
    """Name of a quality preset."""
    light: Annotated[str, Key(words=("follow", "fixed", "preroll"))] = "follow"
    """Light of a clip whose scene has a mirror ball.

    ``follow``: as captured in each frame. ``fixed``: as captured at the clip's end. ``preroll``: each segment captures
    it anew, beginning some frames before the segment.
    """
    segment_frames: Annotated[int | None, Key(low=1)] = None
    """Number of frames of a segment; None: one segment per clip."""
    preroll: Annotated[int, Key(low=0)] = 48
    """Number of frames before a segment from which its light and tracking begin, with ``light = "preroll"``."""
    decode: Annotated[str, Key(words=("cpu", "gpu"))] = "cpu"
    """Decoder of recordings: the processor, or the GPU if it can decode their codec."""
    coding: Annotated[str, Key(words=(AS_RECORDED, *CODINGS))] = AS_RECORDED
    """Coding of the output: one of ``CODINGS``, or ``AS_RECORDED``."""
    digests: Annotated[bool, Key()] = False
    """True to write a digest of every lit picture, computed before encoding."""

    def gpu_of(self, device: str) -> int | None:
        """Return the index of the GPU that decodes for a worker; None: the processor decodes.

        Args:
            device: Device of the worker, ``cpu`` or ``cuda:N``.
        """
        return int(device.partition(":")[2] or 0) if self.decode == "gpu" and device.startswith("cuda") else None


@dataclasses.dataclass(frozen=True)
class Clip:
    """One recording."""

    name: str
    """Name of the clip's outputs, unique among clips."""
    scene: str
    """Path of a scene file, or the name of a bundled scene."""
    source: Path | None = None
    """Video or folder of frames; None: the scene's own."""
    light: Path | None = None
    """File of captured light; None: the scene's own, or light that a mirror ball shows."""
    calibration: Path | None = None
    """Calibration file of the camera; None: the scene's camera."""
    first: int = 0
    """Index of the first lit frame."""
    end: int | None = None
    """Index after the last lit frame; None: all frames."""


@dataclasses.dataclass(frozen=True)
class JobFile:
    """Contents of a job file."""

    settings: Settings
    clips: tuple[Clip, ...]
    dataset: Dataset | None
    """Kinds of objects and lights of a data set; None if recordings are lit."""


@dataclasses.dataclass(frozen=True)
class Job:
    """Unit of work that one worker does."""

    kind: str
    """Kind: ``survey`` (frames, poses and light of a clip), ``segment``, ``variation``, ``join`` or ``index``."""
    clip: int = 0
    """Index of the clip."""
    number: int = 0
    """Index of the segment or variation in its clip."""
    first: int = 0
    """Index of the first frame, for segments and variations."""
    end: int = 0
    """Index after the last frame."""

    def key(self, jobs: JobFile) -> str:
        """Return the job's name in the manifest."""
        if self.kind == "index":
            return "dataset/index"
        name = jobs.clips[self.clip].name
        return f"{name}/{self.kind}" + (f"-{self.number:06d}" if self.kind in ("segment", "variation") else "")

    def place(self, jobs: JobFile) -> Path:
        """Return the path of the job's result relative to the run's folder.

        The result is a folder, or one or more files of which the returned one is written last.
        """
        name = jobs.clips[self.clip].name
        match self.kind:
            case "survey":
                return Path("clips") / name
            case "segment":
                return Path("parts") / name / f"{self.number:06d}"
            case "variation":
                assert jobs.dataset is not None
                return Path("dataset/train") / f"{self.clip * jobs.dataset.variations + self.number:06d}"
            case "join":
                return Path(f"{name}.mp4")
        return Path("dataset/annotations.json")


def jobs_of_clip(jobs: JobFile, clip: int, length: int) -> int:
    """Return the number of segments or variations of a clip.

    Args:
        jobs: The job file.
        clip: Index of the clip.
        length: Number of frames of its source.
    """
    if jobs.dataset is not None:
        return jobs.dataset.variations
    first, end = lit_range(jobs.clips[clip], length)
    return -(-(end - first) // (jobs.settings.segment_frames or max(end - first, 1)))


def job_of_clip(jobs: JobFile, clip: int, number: int, length: int) -> Job:
    """Return one of a clip's segments or variations.

    Args:
        jobs: The job file.
        clip: Index of the clip.
        number: Index of the segment or variation in the clip.
        length: Number of frames of the clip's source.
    """
    first, end = lit_range(jobs.clips[clip], length)
    if jobs.dataset is not None:
        return Job("variation", clip, number, first, end)
    size = jobs.settings.segment_frames or end - first
    start = first + number * size
    return Job("segment", clip, number, start, min(start + size, end))


def variations_of(jobs: JobFile) -> Iterator[Job]:
    """Yield the variations of all clips of a data set, in order."""
    assert jobs.dataset is not None
    for clip, number in itertools.product(range(len(jobs.clips)), range(jobs.dataset.variations)):
        yield Job("variation", clip, number)


def lit_range(clip: Clip, length: int) -> tuple[int, int]:
    """Return the range of a clip's lit frames: index of the first, and index after the last.

    Args:
        clip: The clip.
        length: Number of frames of its source.

    Raises:
        JobsError: The range is empty.
    """
    end = length if clip.end is None else min(clip.end, length)
    if clip.first >= end:
        raise JobsError(f"clip {clip.name}: frames = [{clip.first}, {clip.end}], but it has {length} frames")
    return clip.first, end


def read_jobs(path: str | Path) -> dict[str, Any]:
    """Return the content of a job file, in which patterns of clips are replaced by the matching files.

    The key ``folder`` is added: the absolute path of the folder to which paths are relative.

    Raises:
        JobsError: The file cannot be read, or a pattern matches nothing.
    """
    path = Path(path)
    label = str(path)
    text = read_text(path, JobsError, expected="TOML")
    data = parse_toml(text, label, JobsError)
    folder = path.absolute().parent
    clips = data.get("clip")
    if not isinstance(clips, list) or not clips:
        raise JobsError(f'{label}: [[clip]] is missing: name at least one clip, such as scene = "desk"')
    data["clip"] = [made for index, clip in enumerate(clips) for made in _resolved(label, folder, index, clip)]
    data["folder"] = str(folder)
    return data


def _resolved(label: str, folder: Path, index: int, clip: object) -> list[dict[str, Any]]:
    """Return a table ``[[clip]]`` as one table for each file that its path, a pattern, matches.

    Args:
        label: Name of the job file in messages.
        folder: Folder of the job file.
        index: Index of the table.
        clip: Content of the table.

    Raises:
        JobsError: The pattern matches no file.
    """
    table = JobTable(label, folder, f"clip[{index}]", clip, _CLIP_KEYS)
    pattern = table.text("path", "")
    if not glob.has_magic(pattern) or (folder / pattern).exists():
        return [dict(table.data)]
    found = sorted(glob.glob(pattern, root_dir=folder, recursive=True))
    if not found:
        table.fail("path", f"no file in {folder} matches")
    return [{**table.data, "path": name} for name in found]


def parse_jobs(data: dict[str, Any], label: str) -> JobFile:
    """Check data from ``read_jobs``; every scene is loaded, and every file must exist.

    Args:
        data: Content of the file.
        label: Name of the file in messages.

    Raises:
        JobsError: A key is wrong or missing.
        SceneError: A scene, or a file that it names, cannot be used.
    """
    folder = Path(data.get("folder", "."))
    top = JobTable(label, folder, "", data, ("schema", "run", "clip", "dataset", "folder"))
    if data.get("schema") != SCHEMA:
        top.fail("schema", f"expected {SCHEMA}")
    run = JobTable(label, folder, "run", data.get("run", {}), list(fields_of(Settings)))
    settings: Settings = run.read(Settings)
    names: dict[str, int] = {}
    clips = []
    for index, entry in enumerate(data["clip"]):
        clips.append(_read_clip(JobTable(label, folder, f"clip[{index}]", entry, _CLIP_KEYS), names))
    dataset = None if "dataset" not in data else read_dataset(label, folder, data["dataset"])
    if dataset is not None and settings.light == "preroll":
        run.fail("light", 'a data set needs light that is captured once; "follow" or "fixed"')
    if dataset is not None and settings.coding != AS_RECORDED:
        run.fail("coding", "a data set is pictures of 8 bits; leave it out")
    if dataset is not None and settings.digests:
        run.fail("digests", "the manifest has a digest of each variation already; leave it out")
    jobs = JobFile(settings, tuple(clips), dataset)
    for scene in {clip.scene: index for index, clip in reversed(list(enumerate(clips)))}.values():
        _check_exposure(label, jobs, clips[scene], scene_of(jobs, scene))
    return jobs


def _check_exposure(label: str, jobs: JobFile, clip: Clip, scene: Scene) -> None:
    """Check that the exposure in a job's frames does not depend on earlier frames, which the job does not read.

    Raises:
        JobsError: The scene's metering or its scale of the exposure adapts over frames, which the settings cut.
    """
    settings = jobs.settings
    whole = settings.light == "preroll" and settings.segment_frames is None
    if scene.source is not None and scene.source.metering == "automatic" and not whole:
        raise JobsError(
            f'{label}: clip {clip.name}: scene {clip.scene} says source.metering = "automatic", whose drift is '
            'measured from all earlier frames; expected run.light = "preroll" without segment_frames, or metering = '
            '"fixed"'
        )
    cut = settings.segment_frames is not None and settings.light != "preroll"
    if scene.exposure.scale == "auto" and jobs.dataset is None and cut:
        raise JobsError(
            f'{label}: clip {clip.name}: scene {clip.scene} says exposure.scale = "auto", which adapts from frame to '
            'frame; expected no run.segment_frames, run.light = "preroll", or a number as scale'
        )


def _read_clip(table: JobTable, names: dict[str, int]) -> Clip:
    """Return one clip, and add its name to ``names``, which counts the uses of each name."""
    scene = table.text("scene", "desk")
    source, light, calibration = (table.path(key) for key in ("path", "light", "calibration"))
    if source is not None and not (is_file(source) or is_folder(source)):
        table.fail("path", f"there is no file or folder {source}")
    for key, file in (("light", light), ("calibration", calibration)):
        if file is not None and not is_file(file):
            table.fail(key, f"there is no file {file}")
    in_folder = table.folder / scene
    if is_file(in_folder):
        scene = str(in_folder)
    name = table.text("name") if "name" in table else None
    if name is not None and (not _NAME.fullmatch(name) or name in names):
        table.fail("name", "expected letters, digits, dots and dashes that no other clip has")
    if name is None:
        stem = re.sub(r"[^A-Za-z0-9._-]+", "-", (source or Path(scene)).stem).strip(".-") or "clip"
        name = stem[:80]
        while name in names:
            names[stem[:80]] += 1
            name = f"{stem[:80]}-{names[stem[:80]]}"
    names[name] = names.get(name, 0) + 1
    first, end = table.pair("frames", (0, 0), low=0)
    if "frames" in table and first == end:
        table.fail("frames", "expected [first, behind the last], at least one frame")
    return Clip(name, scene, source, light, calibration, first, end if "frames" in table else None)


@functools.lru_cache(maxsize=256)
def _load_scene(name: str) -> Scene:
    return load_scene(Path(name) if is_file(name) else name)


def scene_of(jobs: JobFile, clip: int) -> Scene:
    """Return the scene of a clip, with the camera and the captured light that the clip names.

    Raises:
        SceneError: The scene cannot be used.
        JobsError: The scene names no source that can be read repeatedly.
    """
    spec = jobs.clips[clip]
    scene = _load_scene(spec.scene)
    if spec.calibration is not None:
        scene = dataclasses.replace(scene, camera=load_calibration(spec.calibration, scene.camera.transfer))
    if spec.light is not None:
        captured = scene.captured or CapturedLight(spec.light)
        scene = dataclasses.replace(scene, captured=dataclasses.replace(captured, file=spec.light))
    own = scene.source
    if spec.source is None and (own is None or own.path is None):
        raise JobsError(f"clip {spec.name}: scene {spec.scene} names no recording; give the clip a path")
    if spec.source is None and own is not None and own.exposures:
        raise JobsError(f"clip {spec.name}: its frames alternate between exposures, which a farm does not light")
    if scene.pose is not None and spec.source is not None and scene.has_marker:
        raise SceneError(f"clip {spec.name}: scene {spec.scene} gives poses of its own recording; leave path out")
    return scene


def source_of(jobs: JobFile, clip: int) -> tuple[Path, float | None]:
    """Return the file or folder of a clip's frames, and the frame rate that replaces its own, or None."""
    spec, own = jobs.clips[clip], scene_of(jobs, clip).source
    if spec.source is not None:
        return spec.source, None
    assert own is not None
    assert own.path is not None
    return own.path, own.fps


def inputs_of(jobs: JobFile, clip: int) -> list[Path]:
    """Return the files and folders that determine a clip's pictures: recording, scene, calibration, light, meshes."""
    spec, scene = jobs.clips[clip], scene_of(jobs, clip)
    named: list[Path | None] = [source_of(jobs, clip)[0], Path(spec.scene), spec.calibration]
    named += [None if scene.captured is None else scene.captured.file]
    named += [*(item.file for item in scene.objects), *(proxy.file for proxy in scene.proxies)]
    named += [] if jobs.dataset is None else [kind.item.file for kind in jobs.dataset.catalogue]
    return [path for path in dict.fromkeys(named) if path is not None and path.exists()]


@dataclasses.dataclass(frozen=True)
class Context:
    """Data that a worker needs for every job of a run."""

    jobs: JobFile
    folder: Path
    """Folder of the run."""
    device: str
    """``cpu`` or ``cuda:N``."""
    worker: int = 0
    """Index of the worker."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a job."""

    state: str
    """State: ``done``, ``failed``, ``full`` (the disk is full), or ``lost`` (the worker died repeatedly)."""
    values: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Values for the job's line of the manifest."""
    reason: str = ""
    """Error of a failed job, on one line."""


_LIBRARIES = ("warp-lang", "numpy", "opencv-contrib-python-headless", "av")
"""Libraries whose versions affect pictures or their encoded bytes."""


@functools.cache
def program_version() -> str:
    """Return the package's version, a digest of its code, and the libraries' versions, on one line."""
    root = Path(warp_ar.__file__).parent
    digest = hashlib.sha256()
    for folder in (root, root / "kernels"):  # kernels may be a link, which rglob does not follow
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    own = f"warp_ar {installed_version('warp-ar')} {digest.hexdigest()[:12]}"
    return ", ".join([own, *(f"{name} {installed_version(name)}" for name in _LIBRARIES)])
