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

from warp_ar.ball.ball_finder import BallOutline, exact_outline, far_camera, find_ball, sphere_of_circle
from warp_ar.calibration.response import write_response
from warp_ar.checks.check_ball import DULL, disc_contrast
from warp_ar.declared import checked
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.recovery.recover_cells import cell_shape
from warp_ar.light.captured import Light, find_emitters, irradiance_above, texel_solid_angles
from warp_ar.light.priors import least_missing
from warp_ar.photographs.bracket import Aligned, Circle, agree_exposures, align, thin_exposures
from warp_ar.photographs.photographs import Photograph, exposures_by_exif, exposures_by_name, read_photograph
from warp_ar.photographs.support import Support
from warp_ar.photographs.table_seen import WHITEST, Table
from warp_ar.scene import Camera, Pose, Probe, Scene
from warp_ar.scene.exif import FULL_FRAME_DIAGONAL
from warp_ar.scene.pose_file import pose_of_position
from warp_ar.stages.quality import PRESETS

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Image = NDArray[np.uint8]
RGB = tuple[float, float, float]

PIXELS: Final = "pixels"
"""In the place of exposures: what the pictures themselves tell."""
HEIGHTS = 128, 2048
"""Rows of the environment, at least and at most, where they follow the ball."""
WINDOW = 1.25
"""Half side, in radii, of the part of a photograph that is unwrapped."""
NEAR = 0.08
"""Share of the radius by which the ball lies elsewhere in another photograph of a bracket, at most."""
SHIFTED = 0.05
"""Share of the radius from which on a photograph's shift is doubted."""
BRACKET_ERROR = 0.05
"""Relative error of merged radiance: what a response that was estimated or assumed leaves."""
GUESS = 0.85
"""Reflectance of a ball that nothing tells: a silvered ornament's."""
LEAST_CLIPPED = 0.05
"""Share of the irradiance that must clip for light that is lacking to be looked for there."""
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
    """Camera of that photograph."""
    picture: Image
    """That photograph, uint8 RGB, upright."""
    support: Support | None
    """The plane that the ball stands on, where it was asked for."""
    notes: tuple[str, ...]
    """Notes for the user, a line each."""
    response: Array | None = None
    """Linear value of each code, (256, 3), where it was estimated from the bracket."""


@checked
def capture_light(
    paths: Sequence[str | Path],
    *,
    ball: Sequence[float] | None = None,
    circle: Sequence[float] | None = None,
    exposures: Sequence[float] | Literal["pixels"] | None = None,
    shown: int | None = None,
    transfer: str = "srgb",
    focal_35mm: float | None = None,
    support: Callable[[BallOutline, Camera], Support] | None = None,
    reflectance: float | None = None,
    device: str = "auto",
    height: int | None = None,
    raises: bool = True,
) -> Capture:
    """Capture the light that a mirror ball shows in one photograph or a bracket of them.

    Args:
        paths: Photographs of the ball, from one place, at one or more exposures.
        ball: Column, row and radius in pixels of a rough circle around the ball in the shown photograph; None: look
            for it.
        circle: The same of a circle that is exact, in the place of a rough one.
        exposures: Seconds of each photograph, instead of what EXIF or names say; ``pixels``: by the pictures alone,
            under ``transfer``.
        shown: Which photograph's camera values the light is in; None: the one whose ball is best exposed.
        transfer: Response that is tried first.
        focal_35mm: Focal length for a full frame in millimetres, of the picture as it is; None: by EXIF.
        support: Finds the plane that the ball stands on, whose axes the light then has; None: a level camera's.
        reflectance: Of the ball; None: by what it mirrors of the support's plane, else ``GUESS``.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        height: Rows of the map; None: as many as the ball's pixels tell.
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
    if circle is None:
        outline, taken_from = _find_outline(photos, reference, camera, ball)
    else:
        outline, taken_from = exact_outline(reference.image, camera, circle), None
    bracket = _merge_plan(photos, reference, outline, transfer, exposures)
    notes += [*bracket.notes, _describe_outline(outline)]
    if taken_from is not None:
        notes.append(
            f"{reference.name} shows no rim of the ball: this outline is that of {taken_from.name}, at the same place; "
            "if the camera moved in between, show a brighter photograph (--shown)"
        )
    if outline.is_doubtful:
        notes.append(
            "this outline is doubtful: look at its picture; if it is wrong, give a rough circle (--ball) or an exact "
            "one (--circle)"
        )
    if disc_contrast(reference.image, (*outline.center, outline.radius)) < DULL:
        notes.append("where the ball is found, the picture is flat: is a ball there, uncovered and polished?")
    found = None if support is None else support(outline, camera)
    turn = np.array(pose_of_position((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))[0]).reshape(3, 3)
    if found is not None:
        turn = found.pose.rotation
        notes.append(f"the support's normal is known within {found.tilt_deviation:.1f} degrees")
    table = None
    if found is not None:
        codes = decode_table(transfer) if bracket.curve is None else bracket.curve.astype(np.float32)
        table = Table.under(outline, reference.image, camera, found, codes)
    mirrored, note = _ball_reflectance(table, reflectance)
    notes.append(note)
    maps = _unwrap(bracket, reference, camera, outline, turn, mirrored, device, height or _rows_of(outline.radius))
    light, more = _make_light(maps, bracket, table, raises)
    light = dataclasses.replace(light, exposure=reference.info.exposure)
    notes += [*maps.notes, *more]
    return Capture(light, outline, reference.path, camera, reference.image, found, tuple(notes), bracket.curve)


def _rows_of(radius: float) -> int:
    """Return the rows of a map as fine as a ball of so many pixels: at its middle one of them mirrors 2 / radius."""
    rows = 1 << math.floor(math.log2(0.5 * math.pi * radius))
    return min(max(rows, HEIGHTS[0]), HEIGHTS[1])


def _ball_reflectance(table: Table | None, given: float | None) -> tuple[RGB, str]:
    """Return what the ball reflects, and what is to be said of it."""
    told = None if table is None else table.reflectance_of_ball()
    if told is None and given is None:
        how = "give --reflectance" + ", --contact or --rectangle" * (table is None)
        return (GUESS,) * 3, f"the ball is taken to reflect {GUESS:g} of its light; all light is off by as much: {how}"
    looks = ""
    if told is not None:
        middle = float(np.mean(told.reflectance))
        low, high = (middle * math.exp(sign * 2.0 * told.deviation) for sign in (-1.0, 1.0))
        seen = f"{middle:.2f} ({low:.2f} to {min(high, 1.0):.2f}) of its light, by the table that it mirrors"
        if given is None:
            red, green, blue = (min(value, 1.0) for value in told.reflectance)
            return (red, green, blue), f"the ball reflects {seen}"
        looks = "" if low <= given <= high else f"; it looks like {seen}"
    assert given is not None
    return (given,) * 3, f"the ball reflects {given:g}, as was given{looks}"


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
    """Return the place of a ball in a picture of another size: cut differently around it, at about the same share."""
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
    """Return the photographs to merge, the place of the ball in them, and their exposures."""
    circle = (*outline.center, outline.radius)
    if len(photos) == 1:
        note = f"one photograph tells no response: {transfer} is taken; by a phone's, darks may be 3 times darker"
        return _Bracket((reference,), (circle,), (1.0,), None, (note,))
    claims: dict[str, Sequence[float] | None] = {"given": None, "exif": None, "names": None}
    if not isinstance(given, str):
        claims = {"given": given, "exif": exposures_by_exif(photos), "names": exposures_by_name(photos)}
    told = [photo.info.exposure is not None for photo in photos]
    untold = [photo for photo, tells in zip(photos, told, strict=True) if any(told) and not tells]
    # Brightness tells the order even where claims contradict each other.
    order = sorted(range(len(photos)), key=lambda k: -float(photos[k].image[::8, ::8].mean()))
    chosen = [photos[k] for k in order]
    known = next((claim for claim in claims.values() if claim is not None), None)
    times = None if known is None else [known[k] for k in order]
    rough = [_same_place(circle, reference.image, photo.image) for photo in chosen]
    aligned = align([photo.image for photo in chosen], rough, times, chosen.index(reference))
    notes = [f"{photo.name} is left out: {why}" for photo, why in zip(chosen, aligned.strangers, strict=True) if why]
    notes += [f"{photo.name} tells no exposure, so none is taken from EXIF" for photo in untold]
    notes += _shift_notes(chosen, aligned, rough, outline.radius)
    stay = [k for k, why in enumerate(aligned.strangers) if not why]
    picked = {name: None if claim is None else [claim[order[k]] for k in stay] for name, claim in claims.items()}
    agreed = agree_exposures(
        [aligned.patches[k] for k in stay], transfer, picked["exif"], picked["names"], picked["given"],
        [chosen[k].name for k in stay],
    )  # fmt: skip
    first = [chosen[k] for k in stay].index(reference)
    kept, more = thin_exposures(agreed.ratios, first, [chosen[k].name for k in stay])
    return _Bracket(
        tuple(chosen[stay[k]] for k in kept),
        tuple(aligned.circles[stay[k]] for k in kept),
        tuple(agreed.ratios[k] for k in kept),
        agreed.curve,
        (*notes, *agreed.notes, *more),
    )


def _shift_notes(photos: Sequence[Photograph], aligned: Aligned, rough: Sequence[Circle], radius: float) -> list[str]:
    shifts = [
        0.0 if why else math.hypot(found[0] - start[0], found[1] - start[1])
        for found, start, why in zip(aligned.circles, rough, aligned.strangers, strict=True)
    ]
    most = max(shifts)
    name = photos[shifts.index(most)].name
    doubt = f": the camera was moved, which shifts near things; leave {name} out" if most > SHIFTED * radius else ""
    return [f"{name} lies {most:.1f} pixels apart at the ball; it was aligned{doubt}"] if most > 0.5 else []


@dataclasses.dataclass(frozen=True)
class _Maps:
    """Merged map of all photographs."""

    radiance: Map
    """(height, 2 height, 3), in camera values."""
    confidence: Map
    """(height, 2 height)."""
    clipped: Map
    """Share that clips in every exposure, of the radiance's shape."""
    notes: tuple[str, ...]
    """Notes for the user."""


def _unwrap(
    bracket: _Bracket,
    reference: Photograph,
    camera: Camera,
    outline: BallOutline,
    turn: Array,
    reflectance: RGB,
    device: str,
    height: int,
) -> _Maps:
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
            probes=(Probe((0.0, 0.0, 0.0), 1.0, reflectance),),
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
        return _Maps(np.array(radiance), confidence, clipped, tuple(pipeline.bracket.notes))


def _make_light(maps: _Maps, bracket: _Bracket, table: Table | None, raises: bool) -> tuple[Light, list[str]]:
    """Return the light of a map, with what clips raised as far as that is known, and what is to be said of it."""
    single, radiance, clipped = len(bracket.photos) == 1, maps.radiance, maps.clipped
    if raises and single:
        radiance = _raised(radiance, maps.confidence, clipped)
    area = texel_solid_angles(len(radiance))[..., None]
    whole = float((radiance * area).sum())
    share = float((radiance * clipped * area).sum() / max(whole, 1e-12))
    notes = []
    if share > 0.0:
        what = "the photograph" if single else "the shortest exposure"
        notes.append(f"{what} still clips: {share:.1%} of the light is a lower bound")
    more = whole / max(float((maps.radiance * area).sum()), 1e-12) - 1.0
    if more > LEAST_SAID:
        notes.append(
            f"what clips was raised, which makes {more:.0%} more light: nearly every place has as much; a shorter "
            "photograph beside this one measures it (--as-clipped leaves it out)"
        )
    if table is not None:
        radiance, said = _bounded(radiance, clipped, table, raises)
        notes += said
    emitters = find_emitters(radiance, clipped, BRACKET_ERROR, maps.radiance)
    return Light(radiance, maps.confidence, emitters, 1.0, None, share), notes


def _bounded(radiance: Map, clipped: Map, table: Table, raises: bool) -> tuple[Map, list[str]]:
    """Return a map that is bright enough for the table to be no whiter than ``WHITEST``, and what is to be said."""
    whole, bounds = irradiance_above(radiance), irradiance_above(radiance * clipped).mean()
    lacking = table.reflectance_under(whole) / WHITEST
    if lacking <= 1.0:
        return radiance, []
    note = f"the table would reflect {WHITEST * lacking:.2f} of this light, and none reflects more than {WHITEST}"
    if not raises:
        return radiance, [f"{note}: the light is too low"]
    if bounds < LEAST_CLIPPED * whole.mean():
        return lacking * radiance, [f"{note}: all light was raised {lacking:.2f} times; what does --reflectance say?"]
    grow = float((lacking - 1.0) * whole.mean() / bounds)
    raised = np.asarray(radiance * (1.0 + grow * clipped), np.float32)
    return raised, [f"{note}: what clips was raised {1.0 + grow:.2f} times"]


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
