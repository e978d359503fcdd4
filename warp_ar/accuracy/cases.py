"""Cases: a scene's frames with their poses, and pictures of the truth where there are any."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.metrics import changed_region, clipped_region
from warp_ar.engine.graph import make_plan
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Pose, Scene, bundled_scenes, load_scene
from warp_ar.sources.sources import Frame, open_source
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request
from warp_ar.tracking.tracking import Tracker

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
LIGHT_RADIUS = 0.02
"""Metres, of ``sized_light``: a light bulb."""
SIZED = ", sized light"
"""Suffix of the name of such a case."""
VERSIONS = ("both", "object", "light", "dark_50", "dark_25")
"""Kinds of truth that a case may have; ``object`` and ``light`` are swept only where there is no ``both``."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene with frames, and pictures of how it should look."""

    name: str
    scene: Scene
    frames: tuple[Frame, ...]
    poses: tuple[Pose | None, ...]
    truth: Mapping[int, Image]
    """Pictures that the camera would have taken, by frame; empty where that is not known."""
    regions: Mapping[int, Mask] = dataclasses.field(default_factory=dict)
    """Pixels that anything virtual changes, or that clip, where the truth says so."""

    @property
    def darker(self) -> bool:
        """Return whether only clipped pixels matter: at another exposure all others are scaled, to rounding."""
        return is_darker(self.scene)

    @property
    def shown(self) -> tuple[int, ...]:
        """Frames whose pictures are compared."""
        return tuple(self.truth) or (len(self.frames) - 1,)


def read_image(path: Path) -> Image:
    """A picture as uint8 RGB, or RGBA if it says where it is transparent.

    Raises:
        UsageError: It cannot be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 3:
        raise UsageError(f"cannot read the picture {path}; expected 8-bit colour")
    order = (2, 1, 0, 3)[: image.shape[2]]
    return np.ascontiguousarray(image[..., order])


def shrink(image: Image, times: int) -> Image:
    """A picture at a whole fraction of its size."""
    if times == 1:
        return image
    size = image.shape[1] // times, image.shape[0] // times
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def load_case(
    name: str,
    scene: Scene,
    count: int,
    truth: Mapping[int, Image] | None = None,
    times: int = 1,
    first: int = 0,
) -> Case:
    """Read frames, and find the marker in each once.

    Args:
        name: For tables.
        scene: Its clip is read.
        count: Frames at most.
        truth: By number of the frame in the clip: RGB, or RGBA that is transparent where nothing changes.
        times: By how much everything is shrunk.
        first: Number of the first frame.

    Raises:
        UsageError: The scene names no clip.
        SourceError: It cannot be read.
    """
    if scene.source is None or scene.source.path is None:
        raise UsageError(f"scene {scene.name!r} has no clip to compare methods on; expected [source] path")
    with open_source(scene.source.path, fps=scene.source.fps) as source:
        whole = tuple(itertools.islice(source, first, first + count))
        width, height = source.size
        scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(width // times, height // times))
    frames = tuple(dataclasses.replace(frame, image=shrink(frame.image, times)) for frame in whole)
    poses: tuple[Pose | None, ...] = (None,) * len(frames)
    if make_plan(Request(scene, PRESETS["reference"], (scene.camera.width, scene.camera.height))).needs("pose"):
        tracker = Tracker(scene.marker, scene.camera)
        poses = tuple(tracker.track(frame.image, frame.time).pose for frame in frames)
    pictures: dict[int, Image] = {}
    regions: dict[int, Mask] = {}
    for number, picture in (truth or {}).items():
        index = number - first
        if 0 <= index < len(frames):
            complete, region = _complete(scene, whole[index].image, picture)
            pictures[index] = shrink(complete, times)
            regions[index] = shrink(region.astype(np.uint8) * 255, times) > 0
    return Case(name, scene, frames, poses, pictures, regions)


def _complete(scene: Scene, camera: Image, truth: Image) -> tuple[Image, Mask]:
    """The truth's whole picture, and the region in which it says anything that the frame does not."""
    scale = scene.exposure.scale
    if truth.shape[2] == 3:
        return truth, clipped_region(camera) if is_darker(scene) else changed_region(camera, truth)
    # Where the truth is transparent nothing changes but the exposure, and nothing clips.
    rest = camera if isinstance(scale, str) else scale_codes(camera, scale, scene.camera.transfer)
    region = truth[..., 3] > 0
    return np.where(region[..., None], truth[..., :3], rest), region


def is_darker(scene: Scene) -> bool:
    """Return whether a scene asks for a shorter exposure and nothing else that the frame does not show."""
    scale = scene.exposure.scale
    return not isinstance(scale, str) and scale < 1.0 and not scene.objects and not scene.lights


def scale_codes(image: Image, scale: float, transfer: str | Path) -> Image:
    """A frame at another exposure, as far as nothing in it clips."""
    values = decode_table(transfer)
    codes = np.arange(256)
    tables = [np.interp(column * scale, column, codes) + 0.5 for column in values.T]
    return np.stack([table.astype(np.uint8)[image[..., k]] for k, table in enumerate(tables)], -1)


def read_truth(folder: Path) -> dict[int, Image]:
    """Pictures of a folder of ``NNNN.png`` by their numbers."""
    return {int(path.stem): read_image(path) for path in sorted(folder.glob("*.png"))}


def truth_of(scene_file: Path) -> Path | None:
    """Folder of pictures that a scene file of a case comes with: ``both`` beside ``scene_both.toml``."""
    folder = scene_file.parent / scene_file.stem.removeprefix("scene_")
    return folder if scene_file.stem.startswith("scene_") and folder.is_dir() else None


def open_scene(name: str, count: int, times: int = 1) -> Case:
    """A case from a scene file or a bundled scene, with the truth that it comes with.

    Bundled scenes come with one true frame, ``truth/SCENE_NNNN.png``; the frames end with it.

    Args:
        name: Of a bundled scene, or a scene file.
        count: Frames at most.
        times: By how much everything is shrunk.

    Raises:
        WarpArError: The scene or its clip cannot be read.
    """
    path = Path(name)
    if path.is_file():
        folder = truth_of(path)
        return load_case(path.stem, load_scene(name), count, read_truth(folder) if folder else None, times)
    scene = load_scene(name)
    found = sorted((bundled_scenes()[name].parent / "truth").glob(f"{name}_[0-9]*.png"))
    if not found:
        return load_case(name, scene, count, None, times)
    number = int(found[0].stem.rpartition("_")[2])
    return load_case(name, scene, count, {number: read_image(found[0])}, times, max(0, number + 1 - count))


def sized_light(case: Case) -> Case:
    """The case with virtual lights that have a size, whose shadows are soft; what they truly look like is not known."""
    lights = tuple(dataclasses.replace(light, radius=LIGHT_RADIUS) for light in case.scene.lights)
    scene = dataclasses.replace(case.scene, lights=lights)
    return dataclasses.replace(case, name=case.name + SIZED, scene=scene, truth={}, regions={})


def truth_folders(truth: Path) -> list[Path]:
    """Cases under a folder, or the folder itself if it is one."""
    return [truth] if (truth / "case.json").is_file() else sorted(path for path in truth.iterdir() if path.is_dir())


def open_cases(
    scenes: Sequence[str],
    truth: Path | None,
    count: int,
    times: int = 1,
    versions: Sequence[str] = VERSIONS,
) -> Iterator[Case]:
    """Scenes, or cases with truth, or both; neither means the bundled scene ``desk``.

    Args:
        scenes: Scene files or names of bundled scenes; ``all`` alone means every bundled one, and ``sized_light``.
        truth: A case's folder, or one of such folders.
        count: Frames of each.
        times: By how much everything is shrunk.
        versions: Kinds of truth.

    Raises:
        UsageError: A file cannot be read, or ``truth`` holds no case.
    """
    names = scenes or ([] if truth is not None else ["desk"])
    for name in bundled_scenes() if names == ["all"] else names:
        yield open_scene(name, count, times)
    if names == ["all"]:
        yield sized_light(open_scene("desk", count, times))
    if truth is None:
        return
    found = False
    for folder in truth_folders(truth):
        own = [version for version in versions if (folder / f"scene_{version}.toml").is_file()]
        if "both" in own:
            own = [version for version in own if version not in ("object", "light")]
        for version in own:
            found = True
            scene = load_scene(folder / f"scene_{version}.toml")
            name = f"{folder.name.replace('_', ' ')}, {version.replace('_', ' ')}"
            yield load_case(name, scene, count, read_truth(folder / version), times)
    if not found:
        raise UsageError(f"--truth {truth}: expected folders with scene_*.toml, as scene_both.toml beside both/")
