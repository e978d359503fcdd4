"""From photographs of a mirror ball, without a marker, to captured light."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_finder import BallOutline, far_camera, find_ball, sphere_of_circle
from warp_ar.calibration.response import write_response
from warp_ar.checks.check_ball import DULL, disc_contrast
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.kernels.recovery.recover_cells import cell_shape
from warp_ar.light.captured import Light, find_emitters, texel_solid_angles
from warp_ar.light.least_missing import least_missing
from warp_ar.photographs.bracket import MOVED, Aligned, Circle, agree_exposures, align, thin_exposures
from warp_ar.photographs.photographs import Photograph, exposures_by_exif, exposures_by_name, read_photograph
from warp_ar.photographs.support import Support
from warp_ar.scene import Camera, Pose, Probe, Scene
from warp_ar.scene.exif import FULL_FRAME_DIAGONAL
from warp_ar.scene.pose_file import pose_of_position
from warp_ar.stages.quality import PRESETS

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Image = NDArray[np.uint8]

PIXELS: Final = "pixels"
"""In the place of exposures: what the pictures themselves tell."""
HEIGHT = 128
"""Rows of the environment."""
WINDOW = 1.25
"""Half side, in radii, of the part of a photograph that is unwrapped."""
NEAR = 0.08
"""Share of the radius by which the ball lies elsewhere in another photograph of a bracket, at most."""
BRACKET_ERROR = 0.05
"""Relative error of merged radiance: what a response that was estimated or assumed leaves."""
SEEN = 0.25
"""Mean confidence from which a part of the map was seen."""
LEAST_SAID = 0.005
"""Share of the light from which it is said that it was added."""


@dataclasses.dataclass(frozen=True)
class Capture:
    """Captured light, and how it came about."""

    light: Light
    """The light, in axes whose z is up where the camera was level."""
    outline: BallOutline
    """The ball in the photograph that was shown."""
    shown: Path
    """That photograph."""
    camera: Camera
    """Of that photograph."""
    picture: Image
    """That photograph, uint8 RGB, upright."""
    support: Support | None
    """The plane that the ball stands on, where it was asked for."""
    notes: tuple[str, ...]
    """What a user should know, a line each."""


def capture_light(
    paths: Sequence[str | Path],
    *,
    ball: Sequence[float] | None = None,
    exposures: Sequence[float] | Literal["pixels"] | None = None,
    shown: int | None = None,
    transfer: str = "srgb",
    focal_35mm: float | None = None,
    support: Callable[[BallOutline, Camera], Support] | None = None,
    reflectance: float = 0.85,
    device: str = "auto",
    height: int = HEIGHT,
    raises: bool = True,
) -> Capture:
    """Capture the light that a mirror ball shows in one photograph or a bracket of them.

    Args:
        paths: Photographs of the ball, from one place, at one or more exposures.
        ball: Column, row and radius in pixels of a rough circle around the ball in the shown photograph; None: look
            for it.
        exposures: Seconds of each photograph, instead of what EXIF or names say; ``pixels``: by the pictures alone,
            under ``transfer``.
        shown: Which photograph's camera values the light is in; None: the one whose ball is best exposed.
        transfer: Response that is tried first.
        focal_35mm: Focal length for a full frame in millimetres, of the picture as it is; None: by EXIF.
        support: Finds the plane that the ball stands on, whose axes the light then has; None: a level camera's.
        reflectance: Of the ball.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        height: Rows of the map.
        raises: Whether what clips in a single photograph is raised by what nearly every place lacks
            (``light/least_missing.py``).

    Raises:
        SourceError: A photograph cannot be read.
        UsageError: Exposures contradict each other, or no ball is found.
    """
    if not paths:
        raise UsageError("no photographs; expected one or more of a mirror ball")
    photos = [read_photograph(path) for path in paths]
    if exposures is not None and not isinstance(exposures, str) and len(exposures) != len(photos):
        raise UsageError(f"{len(exposures)} exposures for {len(photos)} photographs; expected one for each")
    if shown is not None and not 0 <= shown < len(photos):
        raise UsageError(f"shown = {shown}: expected the number of a photograph, 0 to {len(photos) - 1}")
    reference = photos[shown] if shown is not None else photos[_best_exposed(photos)]
    camera, notes = _camera_of(reference, transfer, focal_35mm)
    outline, taken_from = _find_outline(photos, reference, camera, ball)
    bracket = _merge_plan(photos, reference, outline, transfer, exposures)
    notes += [*bracket.notes, _describe_outline(outline)]
    if taken_from is not None:
        notes.append(
            f"{reference.name} shows no rim of the ball: this outline is that of {taken_from.name}, at the same place; "
            "if the camera moved in between, show a brighter photograph (--shown)"
        )
    if outline.is_doubtful:
        notes.append(
            "this outline is doubtful: look at it (--outline FILE draws it), and give a rough circle (--ball) if it is "
            "wrong"
        )
    if disc_contrast(reference.image, (*outline.center, outline.radius)) < DULL:
        notes.append("where the ball is found, the picture is flat: is a ball there, uncovered and polished?")
    found = None if support is None else support(outline, camera)
    turn = np.array(pose_of_position((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))[0]).reshape(3, 3)
    if found is not None:
        turn = found.pose.rotation
        notes.append(f"the support's normal is known within {found.tilt_deviation:.1f} degrees")
    light, more = _unwrap(bracket, reference, camera, outline, turn, reflectance, device, height, raises)
    light = dataclasses.replace(light, exposure=reference.info.exposure)
    return Capture(light, outline, reference.path, camera, reference.image, found, (*notes, *more))


def _best_exposed(photos: Sequence[Photograph]) -> int:
    """The photograph with the most pixels between dark and clipping, in its middle."""

    def share(photo: Photograph) -> float:
        h, w = photo.image.shape[:2]
        middle = photo.image[h // 8 : -h // 8 : 8, w // 8 : -w // 8 : 8].max(2)
        return float(((middle > 30) & (middle < 245)).mean()) if middle.size else 0.0

    return max(range(len(photos)), key=lambda k: share(photos[k]))


def _camera_of(photo: Photograph, transfer: str, focal_35mm: float | None) -> tuple[Camera, list[str]]:
    """The photograph's camera, and what is to be said of it."""
    info = photo.info
    width, height = info.width, info.height
    if focal_35mm is not None:
        # Of the picture as it is, cut or not: who gives it has the angle of view in mind.
        focal = focal_35mm / FULL_FRAME_DIAGONAL * math.hypot(width, height)
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, transfer=transfer), []
    camera = info.camera(transfer)
    if camera is not None:
        return camera, []
    told = info.focal_35mm is not None or info.focal_pixels is not None
    why = "was cut, so that EXIF's focal length says nothing" if told else "has no focal length in its EXIF"
    note = f"{photo.name} {why}: the ball is taken to be far away (--focal-35mm tells otherwise)"
    return dataclasses.replace(far_camera(width, height), transfer=transfer), [note]


def _find_outline(
    photos: Sequence[Photograph], reference: Photograph, camera: Camera, ball: Sequence[float] | None
) -> tuple[BallOutline, Photograph | None]:
    """The ball in the shown photograph; where that is none of the best exposed, near where that one has it.

    Returns:
        The outline, and the photograph whose outline it is where the shown one shows none.
    """
    clearest = photos[_best_exposed(photos)]
    if ball is not None or clearest is reference:
        return find_ball(reference.image, camera, ball), None
    seen = find_ball(clearest.image)
    rough = _same_place((*seen.center, seen.radius), clearest.image, reference.image)
    try:
        own, taken_from = find_ball(reference.image, camera, rough, NEAR), None
    except UsageError:
        # Too dark or too bright to see a rim: it is laid over the others by what it mirrors.
        x, y, z = map(float, sphere_of_circle(camera, *rough))
        larger = rough[2] / seen.radius
        (major, minor), (dx, dy, dr) = seen.axes, seen.deviation
        own = dataclasses.replace(
            seen,
            center=rough[:2],
            axes=(larger * major, larger * minor),
            deviation=(larger * dx, larger * dy, larger * dr),
            sphere=(x, y, z),
        )
        taken_from = clearest
    return dataclasses.replace(own, evidence=seen.evidence), taken_from


def _same_place(circle: Circle, of: Image, other: Image) -> Circle:
    """Where a ball is in a picture of another size: cut differently around it, at about the same share."""
    sy, sx = other.shape[0] / of.shape[0], other.shape[1] / of.shape[1]
    return (circle[0] + 0.5) * sx - 0.5, (circle[1] + 0.5) * sy - 0.5, circle[2] * math.sqrt(sx * sy)


def _describe_outline(outline: BallOutline) -> str:
    (x, y), (dx, dy, dr) = outline.center, outline.deviation
    return (
        f"ball at ({x:.1f}, {y:.1f}) +/- {max(dx, dy):.2f}, radius {outline.radius:.1f} +/- {dr:.2f} pixels, "
        f"{outline.support:.0%} of its rim seen"
    )


@dataclasses.dataclass(frozen=True)
class _Bracket:
    """Photographs to merge, longest exposure first."""

    photos: tuple[Photograph, ...]
    circles: tuple[Circle, ...]
    ratios: tuple[float, ...]
    curve: Array | None
    notes: tuple[str, ...]


def _merge_plan(
    photos: Sequence[Photograph],
    reference: Photograph,
    outline: BallOutline,
    transfer: str,
    given: Sequence[float] | Literal["pixels"] | None,
) -> _Bracket:
    """Which photographs to merge, where the ball is in them, and their exposures."""
    circle = (*outline.center, outline.radius)
    if len(photos) == 1:
        return _Bracket((reference,), (circle,), (1.0,), None, ())
    claims: dict[str, Sequence[float] | None] = {"given": None, "exif": None, "names": None}
    if not isinstance(given, str):
        claims = {"given": given, "exif": exposures_by_exif(photos), "names": exposures_by_name(photos)}
    # Brightness tells the order even where claims contradict each other.
    order = sorted(range(len(photos)), key=lambda k: -float(photos[k].image[::8, ::8].mean()))
    chosen = [photos[k] for k in order]
    known = next((claim for claim in claims.values() if claim is not None), None)
    times = None if known is None else [known[k] for k in order]
    aligned = _align_all(chosen, chosen.index(reference), circle, times)
    moved = [k for k, c in enumerate(aligned.correlation) if math.isfinite(c) and c < MOVED]
    notes = [
        f"{chosen[k].name} is left out: it shows something else ({aligned.correlation[k]:.0%} alike)" for k in moved
    ]
    notes += _shift_notes(chosen, aligned, circle)
    stay = [k for k in range(len(chosen)) if k not in moved]
    picked = {name: None if claim is None else [claim[order[k]] for k in stay] for name, claim in claims.items()}
    agreed = agree_exposures(
        [aligned.patches[k] for k in stay], transfer, picked["exif"], picked["names"], picked["given"]
    )
    first = [chosen[k] for k in stay].index(reference)
    kept, more = thin_exposures(agreed.ratios, first, [chosen[k].name for k in stay])
    return _Bracket(
        tuple(chosen[stay[k]] for k in kept),
        tuple(aligned.circles[stay[k]] for k in kept),
        tuple(agreed.ratios[k] for k in kept),
        agreed.curve,
        (*notes, *agreed.notes, *more),
    )


def _align_all(photos: Sequence[Photograph], reference: int, circle: Circle, times: Sequence[float] | None) -> Aligned:
    """Align outward from the reference, to both sides."""
    shown = photos[reference].image

    def one_way(part: slice) -> Aligned:
        own = [photo.image for photo in photos[part]]
        return align(own, [_same_place(circle, shown, image) for image in own], times and times[part])

    down, up = one_way(slice(reference, None)), one_way(slice(reference, None, -1))
    return Aligned(
        up.circles[:0:-1] + down.circles, up.patches[:0:-1] + down.patches, up.correlation[:0:-1] + down.correlation
    )


def _shift_notes(photos: Sequence[Photograph], aligned: Aligned, circle: Circle) -> list[str]:
    shape = next(photo.image.shape for photo, found in zip(photos, aligned.circles, strict=True) if found == circle)
    shifts = [
        math.hypot(found[0] - circle[0], found[1] - circle[1])
        for photo, found in zip(photos, aligned.circles, strict=True)
        if photo.image.shape == shape
    ]
    most = max(shifts, default=0.0)
    return [f"photographs lie up to {most:.1f} pixels apart at the ball; they were aligned"] if most > 0.5 else []


def _unwrap(
    bracket: _Bracket,
    reference: Photograph,
    camera: Camera,
    outline: BallOutline,
    turn: Array,
    reflectance: float,
    device: str,
    height: int,
    raises: bool,
) -> tuple[Light, list[str]]:
    """The merged map of all photographs, by the pipeline that lights frames."""
    index = bracket.photos.index(reference)
    own = bracket.circles[index]
    half = math.ceil(WINDOW * own[2])
    x0, y0 = round(own[0]) - half, round(own[1]) - half
    side = 2 * half + 1
    window = dataclasses.replace(camera, width=side, height=side, cx=camera.cx - x0, cy=camera.cy - y0)
    sphere = np.array(outline.sphere)
    with tempfile.TemporaryDirectory() as folder:
        if bracket.curve is not None:
            response = Path(folder) / "response.txt"
            write_response(bracket.curve, response)
            window = dataclasses.replace(window, transfer=response)
        scene = Scene(
            camera=window,
            probes=(Probe((0.0, 0.0, 0.0), 1.0, (reflectance,) * 3),),
            has_marker=False,
            name=reference.name,
        )
        times = tuple(bracket.ratios)
        quality = dataclasses.replace(PRESETS["medium"], name="custom", environment_height=height)
        pipeline = Pipeline(
            scene,
            device=device,
            quality=quality,
            outputs=("environment",),
            exposures=times if len(times) > 1 else (),
            shown=times[index] if len(times) > 1 else None,
            estimates="synchronous",
        )
    with pipeline:
        order = [*(k for k in range(len(times)) if k != index), index]
        for k in order:
            image, pose = _place(bracket, k, own, (x0, y0, side), camera, sphere, turn)
            result = pipeline(image, time_seconds=0.0, pose=pose, exposure_time=times[k])
        radiance = result.environment
        assert radiance is not None
        confidence = np.array(pipeline.arrays["environment_confidence"].numpy())
        clipped = np.array(pipeline.arrays["environment_clipped"].numpy())
        left_out = pipeline.bracket.notes
    captured = np.array(radiance)
    if raises and len(times) == 1:
        radiance = _raised(captured, confidence, clipped)
    area = texel_solid_angles(height)
    whole = float((radiance * area[..., None]).sum())
    share = float((radiance * clipped * area[..., None]).sum() / max(whole, 1e-12))
    notes = list(left_out)
    if share > 0.0:
        what = "the shortest exposure" if len(times) > 1 else "the photograph"
        notes.append(f"{what} still clips: {share:.1%} of the light is a lower bound")
    more = whole / max(float((captured * area[..., None]).sum()), 1e-12) - 1.0
    if more > LEAST_SAID:
        notes.append(
            f"what clips was raised, which makes {more:.0%} more light: nearly every place has as much; a shorter "
            "photograph beside this one measures it (--as-clipped leaves it out)"
        )
    emitters = find_emitters(radiance, clipped, BRACKET_ERROR, captured)
    return Light(radiance, confidence, emitters, 1.0, None, share), notes


def _raised(radiance: Map, confidence: Map, clipped: Map) -> Map:
    """A map with what clips raised by what nearly every place lacks, (height, 2 height, 3)."""
    height, width = radiance.shape[:2]
    rows, columns = cell_shape(height, width)

    def reduced(values: Map) -> Map:
        return np.asarray(cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)

    seen = reduced(confidence) > SEEN
    solid_angle = np.broadcast_to(texel_solid_angles(rows), (rows, columns))
    least = least_missing(reduced(radiance), reduced(clipped), solid_angle, seen)
    wide = cv2.resize(least, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(radiance + clipped * wide, np.float32)


def _place(
    bracket: _Bracket,
    k: int,
    own: Circle,
    window: tuple[int, int, int],
    camera: Camera,
    sphere: Array,
    turn: Array,
) -> tuple[Image, Pose]:
    """The window of a photograph about its ball, and the pose that puts the ball there.

    Shifts of a photograph against the shown one become shifts of the ball before the camera: no pixel is resampled.
    """
    x0, y0, side = window
    x, y, radius = bracket.circles[k]
    dx, dy = round(x - own[0]), round(y - own[1])
    image = bracket.photos[k].image
    h, w = image.shape[:2]
    rows = np.clip(np.arange(y0 + dy, y0 + dy + side), 0, h - 1)
    columns = np.clip(np.arange(x0 + dx, x0 + dx + side), 0, w - 1)
    cut = np.ascontiguousarray(image[rows[:, None], columns])
    moved = sphere_of_circle(camera, x - dx, y - dy, radius) - sphere_of_circle(camera, *own)
    center = sphere + moved
    return cut, Pose(turn, center)
