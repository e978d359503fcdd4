"""Cases: frames of a scene with their poses, and pictures of the truth if there are any.

The truth is the picture that the camera would have taken if virtual objects and lights were real.
"""

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
from warp_ar.sources.source import Frame
from warp_ar.sources.sources import open_source
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request
from warp_ar.tracking.tracking import Tracker

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
LIGHT_RADIUS = 0.02
"""Radius in metres of the lights of ``sized_light``: that of a light bulb."""
SIZED = ", sized light"
"""Suffix of the names of cases made by ``sized_light``."""
VERSIONS = ("both", "object", "light", "dark_50", "dark_25")
"""Kinds of true pictures of a case: with virtual object and light, with one of them, or with a shorter exposure.
``object`` and ``light`` are used only if the case has no ``both``."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Frames of a scene, with pictures of how they should look."""

    name: str
    """Name for tables."""
    scene: Scene
    """Scene at the size of the frames."""
    frames: tuple[Frame, ...]
    """Frames of the clip."""
    poses: tuple[Pose | None, ...]
    """``camera_from_world`` of each frame; None if lost or not needed."""
    truth: Mapping[int, Image]
    """Pictures that the camera would have taken, by frame; empty if the truth is unknown."""
    regions: Mapping[int, Mask] = dataclasses.field(default_factory=dict)
    """Mask by frame of the pixels that virtual content changes, or of the clipped ones if the scene only changes the
    exposure; empty if the truth is unknown."""

    @property
    def darker(self) -> bool:
        """True if the scene only shortens the exposure. Then only clipped pixels are compared; others are scaled."""
        return is_darker(self.scene)

    @property
    def shown(self) -> tuple[int, ...]:
        """Indices of the frames whose pictures are compared."""
        return tuple(self.truth) or (len(self.frames) - 1,)


def read_image(path: Path) -> Image:
    """Return a picture as uint8 RGB, or RGBA if it has transparency.

    Raises:
        UsageError: The file cannot be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 3:
        raise UsageError(f"cannot read the picture {path}; expected 8-bit colour")
    order = (2, 1, 0, 3)[: image.shape[2]]
    return np.ascontiguousarray(image[..., order])


def shrink(image: Image, times: int) -> Image:
    """Return a picture reduced by an integer factor."""
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
    """Read frames and find the marker in each.

    Args:
        name: Name for tables.
        scene: Scene whose clip is read.
        count: Largest number of frames.
        truth: True pictures by the frame's index in the clip: RGB, or RGBA that is transparent where nothing changes.
        times: Integer factor by which all pictures are reduced.
        first: Index of the first frame.

    Raises:
        UsageError: The scene names no clip.
        SourceError: The clip cannot be read.
    """
    if scene.source is None or scene.source.path is None:
        raise UsageError(f"scene {scene.name!r} has no clip to compare methods on; expected [source] path")
    with open_source(scene.source.path, fps=scene.source.fps) as source:
        frames = tuple(itertools.islice(source, first, first + count))
        scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(*source.size))
    poses: tuple[Pose | None, ...] = (None,) * len(frames)
    if make_plan(Request(scene, PRESETS["reference"], (scene.camera.width, scene.camera.height))).needs("pose"):
        tracker = Tracker(scene.marker, scene.camera)
        poses = tuple(tracker.track(frame.image, frame.time).pose for frame in frames)
    pictures: dict[int, Image] = {}
    regions: dict[int, Mask] = {}
    for number, picture in (truth or {}).items():
        index = number - first
        if 0 <= index < len(frames):
            pictures[index], regions[index] = _complete(scene, frames[index].image, picture)
    return smaller(Case(name, scene, frames, poses, pictures, regions), times)


def smaller(case: Case, times: int) -> Case:
    """Return a case whose pictures are reduced by an integer factor."""
    camera = case.scene.camera.scaled_to(case.scene.camera.width // times, case.scene.camera.height // times)
    return dataclasses.replace(
        case,
        scene=dataclasses.replace(case.scene, camera=camera),
        frames=tuple(dataclasses.replace(frame, image=shrink(frame.image, times)) for frame in case.frames),
        truth={index: shrink(image, times) for index, image in case.truth.items()},
        regions={index: shrink(region.astype(np.uint8) * 255, times) > 0 for index, region in case.regions.items()},
    )


def _complete(scene: Scene, camera: Image, truth: Image) -> tuple[Image, Mask]:
    """Return the complete true picture of a frame, and the region in which it is compared.

    Args:
        scene: Scene of the case.
        camera: The frame, RGB.
        truth: The true picture, RGB, or RGBA that is transparent where nothing changes.
    """
    scale = scene.exposure.scale
    if truth.shape[2] == 3:
        return truth, clipped_region(camera) if is_darker(scene) else changed_region(camera, truth)
    # In transparent pixels only the exposure changes, and no channel clips.
    rest = camera if isinstance(scale, str) else scale_codes(camera, scale, scene.camera.transfer)
    region = truth[..., 3] > 0
    return np.where(region[..., None], truth[..., :3], rest), region


def is_darker(scene: Scene) -> bool:
    """Return True if a scene changes the picture only by a shorter exposure."""
    scale = scene.exposure.scale
    return not isinstance(scale, str) and scale < 1.0 and not scene.objects and not scene.lights


def scale_codes(image: Image, scale: float, transfer: str | Path) -> Image:
    """Return a frame at ``scale`` times its exposure; the result is valid in unclipped pixels."""
    values = decode_table(transfer)
    codes = np.arange(256)
    tables = [np.interp(column * scale, column, codes) + 0.5 for column in values.T]
    return np.stack([table.astype(np.uint8)[image[..., k]] for k, table in enumerate(tables)], -1)


def read_truth(folder: Path) -> dict[int, Image]:
    """Return the pictures ``NNNN.png`` of a folder by their numbers."""
    return {int(path.stem): read_image(path) for path in sorted(folder.glob("*.png"))}


def truth_of(scene_file: Path) -> Path | None:
    """Return the folder of true pictures of a scene file, such as ``both`` for ``scene_both.toml``; else None."""
    folder = scene_file.parent / scene_file.stem.removeprefix("scene_")
    return folder if scene_file.stem.startswith("scene_") and folder.is_dir() else None


def open_scene(name: str, count: int, times: int = 1) -> Case:
    """Return a case from a scene file or a bundled scene, with its truth.

    A bundled scene has at most one true picture, ``truth/SCENE_NNNN.png``; the case ends with frame NNNN.

    Args:
        name: Name of a bundled scene, or a scene file.
        count: Largest number of frames.
        times: Integer factor by which all pictures are reduced.

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
    """Return the case with virtual lights of finite size, which cast soft shadows; its truth is unknown."""
    lights = tuple(dataclasses.replace(light, radius=LIGHT_RADIUS) for light in case.scene.lights)
    scene = dataclasses.replace(case.scene, lights=lights)
    return dataclasses.replace(case, name=case.name + SIZED, scene=scene, truth={}, regions={})


def truth_folders(truth: Path) -> list[Path]:
    """Return the case folders within a folder, or the folder itself if it is a case."""
    return [truth] if (truth / "case.json").is_file() else sorted(path for path in truth.iterdir() if path.is_dir())


def open_cases(
    scenes: Sequence[str],
    truth: Path | None,
    count: int,
    times: int = 1,
    versions: Sequence[str] = VERSIONS,
) -> Iterator[Case]:
    """Yield cases of scenes, cases with truth, or both; with neither, the bundled scene ``desk``.

    Args:
        scenes: Scene files or names of bundled scenes; ``all`` alone means all bundled scenes and ``sized_light``.
        truth: Folder of a case, or of several case folders.
        count: Largest number of frames of each case.
        times: Integer factor by which all pictures are reduced.
        versions: Kinds of truth to include.

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
