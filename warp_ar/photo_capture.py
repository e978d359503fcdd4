"""Capture of light from photographs of a mirror ball, without a marker."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_finder import BallOutline, exact_outline, far_camera, find_ball, sphere_of_circle
from warp_ar.calibration.chart import measure_chart
from warp_ar.calibration.response import write_response
from warp_ar.checks.check_ball import DULL, disc_contrast
from warp_ar.declared import checked
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError, counted
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.recovery.recover_cells import cell_shape
from warp_ar.light.captured import Light, find_emitters, irradiance_above, texel_solid_angles
from warp_ar.light.priors import least_missing
from warp_ar.photographs.bracket import Aligned, Circle, agree_exposures, align, find_soft, thin_exposures
from warp_ar.photographs.photographs import Photograph, exposures_by_exif, exposures_by_name, read_photograph
from warp_ar.photographs.support import Support, card_points, plane_from_points
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
"""Value of ``exposures``: estimate the exposures from the pictures themselves."""
HEIGHTS = 128, 2048
"""Least and largest number of rows of the environment if it is chosen by the ball's size."""
WINDOW = 1.25
"""Half the side, in radii of the ball, of the part of a photograph that is unwrapped."""
NEAR = 0.08
"""Largest displacement of the ball between photographs of a bracket, in radii."""
SHIFTED = 0.05
"""Displacement of the ball, in radii, from which a note is given."""
BRACKET_ERROR = 0.05
"""Relative error of merged radiance with an estimated or assumed response."""
GUESS = 0.85
"""Reflectance of a ball if nothing measures it: that of a silvered ornament."""
LEAST_CLIPPED = 0.05
"""Share of the irradiance that clipped texels must have for missing light to be estimated there."""
SEEN = 0.25
"""Mean confidence from which a part of the map counts as seen."""
LEAST_SAID = 0.005
"""Share of added light from which a note reports it."""


@dataclasses.dataclass(frozen=True)
class Capture:
    """Captured light with the ball, camera and notes that it was found with."""

    light: Light
    """The light; its z axis points up if the camera was level."""
    outline: BallOutline
    """Outline of the ball in the shown photograph."""
    shown: Path
    """Path of the shown photograph: the light is in its camera values."""
    camera: Camera
    """Camera of the shown photograph."""
    picture: Image
    """Pixels of the shown photograph, uint8 RGB, upright."""
    support: Support | None
    """Plane that the ball stands on; None if neither ``support`` nor the printed card gives it."""
    notes: tuple[str, ...]
    """Notes for the user, one string per line."""
    response: Array | None = None
    """Linear value of each code, (256, 3), if it was estimated from the bracket; else None."""


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
    ball_radius: float | None = None,
    reflectance: float | None = None,
    device: str = "auto",
    height: int | None = None,
    raises: bool = True,
    chart: str | Path | None = None,
) -> Capture:
    """Capture the light that a mirror ball shows in one photograph or in a bracket of exposures.

    Args:
        paths: Photographs of the ball from one viewpoint, at one or more exposures.
        ball: Column, row and radius in pixels of an approximate circle around the ball in the shown photograph; None:
            the ball is searched for.
        circle: Column, row and radius of the exact circle, instead of ``ball``.
        exposures: Exposure time of each photograph in seconds, instead of EXIF's or the file names'; ``pixels``:
            estimated from the pictures with the response ``transfer``.
        shown: Index of the photograph whose camera values the light uses; None: the one with the best exposed ball.
        transfer: Camera response that is tried first.
        focal_35mm: Focal length of the picture as it is, in millimetres for a full frame; None: from EXIF.
        support: Function that finds the plane that the ball stands on. The light uses the plane's axes; None: the
            plane and axes of the printed card if the shown photograph has it, else the axes of a level camera.
        ball_radius: Radius of the ball, metres; None: it stands on the plane.
        reflectance: Reflectance of the ball; None: measured by its reflection of the support's plane, else ``GUESS``.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        height: Rows of the map; None: chosen by the ball's size in pixels.
        raises: Whether clipped light of a single photograph is raised by the least amount that the clipping prior
            expects (``light/priors.py``).
        chart: Photograph of a colour chart by the same camera with the same white balance, of ``paths`` or another: the
            light is in linear sRGB by it, and in camera values times its ``colors``. None: the light is in camera
            values.

    Raises:
        SourceError: A photograph cannot be read.
        UsageError: Exposures contradict each other, or no ball or chart was found.
    """
    if not paths:
        raise UsageError("no photographs; expected one or more of a mirror ball")
    if exposures is not None and not isinstance(exposures, str) and len(exposures) != len(paths):
        told, wanted = counted(len(exposures), "exposure"), counted(len(paths), "photograph")
        raise UsageError(f"{told} for {wanted}; expected one for each")
    photos = [read_photograph(path) for path in paths]
    if shown is not None and not 0 <= shown < len(photos):
        raise UsageError(f"shown = {shown}: expected the number of a photograph, 0 to {len(photos) - 1}")
    # The best exposed, and another one if most differ from it: the odd one may be any.
    order = [shown] if shown is not None else _by_exposure(photos)[: 2 if circle is None and len(photos) > 2 else 1]
    plans: list[Any] = []
    problem = None
    for reference in (photos[k] for k in order):
        camera, notes = _camera_of(reference, transfer, focal_35mm)
        try:
            if circle is None:
                near = photos if shown is not None else [reference]
                outline = _find_outline(near, reference, camera, ball)
            else:
                outline = exact_outline(reference.image, camera, circle)
            bracket = _merge_plan(photos, reference, outline, transfer, exposures)
        except UsageError as error:
            problem = problem or error
            continue
        plans.append((reference, camera, notes, outline, bracket))
        if not bracket.is_odd:
            break
    if problem is not None and not plans:
        raise problem
    reference, camera, notes, outline, bracket = plans[0 if plans[-1][-1].is_odd else -1]
    notes += [*bracket.notes, _describe_outline(outline)]
    if outline.doubts:
        notes.append(
            f"this outline is doubtful ({'; '.join(outline.doubts)}): look at its picture; if it is wrong, give a "
            "rough circle (--ball) or an exact one (--circle)"
        )
    if disc_contrast(reference.image, (*outline.center, outline.radius)) < DULL:
        notes.append("the ball's picture shows no reflections: is a ball there, uncovered and polished?")
    codes = decode_table(transfer) if bracket.curve is None else bracket.curve.astype(np.float32)
    if chart is not None:
        colors, note = measure_chart(read_photograph(chart).image, codes, str(chart))
        notes.append(note)
    found = None
    if support is not None:
        found = support(outline, camera)
        notes.append(f"the support's normal is known within {found.tilt_deviation:.1f} degrees")
    elif (card := card_points(reference.image)) is not None:
        found = plane_from_points(camera, *card)
        notes.append(f"the plane is the printed card's, whose corners are off by {found.error:.1f} pixels")
    if found is not None and ball_radius is not None:
        found = dataclasses.replace(found, ball_radius=ball_radius)
    turn = np.array(pose_of_position((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))[0]).reshape(3, 3)
    table = None
    if found is not None:
        turn = found.pose.rotation
        table = Table.under(outline, reference.image, camera, found, codes)
    mirrored, note = _ball_reflectance(table, reflectance)
    notes.append(note)
    maps = _unwrap(bracket, reference, camera, outline, turn, mirrored, device, height or _rows_of(outline.radius))
    light, more = _make_light(maps, bracket, table, raises)
    light = dataclasses.replace(light, exposure=reference.info.exposure)
    if chart is not None:
        light = dataclasses.replace(light.recolored(colors), colors=tuple(np.linalg.inv(colors).ravel().tolist()))
    notes += [*maps.notes, *more]
    return Capture(light, outline, reference.path, camera, reference.image, found, tuple(notes), bracket.curve)


def _rows_of(radius: float) -> int:
    """Return the rows of a map that resolves the ball's centre, where one of its pixels spans 2 / radius radians."""
    rows = 1 << math.floor(math.log2(0.5 * math.pi * radius))
    return min(max(rows, HEIGHTS[0]), HEIGHTS[1])


def _ball_reflectance(table: Table | None, given: float | None) -> tuple[RGB, str]:
    """Return the ball's reflectance and a note about its origin."""
    told = None if table is None else table.reflectance_of_ball()
    if told is None and given is None:
        how = "give --reflectance" + ", --contact or --rectangle" * (table is None)
        return (GUESS,) * 3, f"the ball is assumed to reflect {GUESS:g} of its light, which scales all light: {how}"
    looks = ""
    if told is not None:
        middle = float(np.mean(told.reflectance))
        low, high = (middle * math.exp(sign * 2.0 * told.deviation) for sign in (-1.0, 1.0))
        seen = f"{middle:.2f} ({low:.2f} to {min(high, 1.0):.2f}) of its light, from the table's reflection"
        if given is None:
            red, green, blue = (min(value, 1.0) for value in told.reflectance)
            return (red, green, blue), f"the ball reflects {seen}"
        looks = "" if low <= given <= high else f"; it looks like {seen}"
    assert given is not None
    return (given,) * 3, f"the ball reflects {given:g}, as given{looks}"


def _by_exposure(photos: Sequence[Photograph]) -> list[int]:
    """Return the indices of photographs, those first whose middle has the most pixels neither dark nor clipped."""

    def share(photo: Photograph) -> float:
        h, w = photo.image.shape[:2]
        middle = photo.image[h // 8 : -h // 8 : 8, w // 8 : -w // 8 : 8].max(2)
        return float(((middle > 30) & (middle < 245)).mean()) if middle.size else 0.0

    return sorted(range(len(photos)), key=lambda k: -share(photos[k]))


def _camera_of(photo: Photograph, transfer: str, focal_35mm: float | None) -> tuple[Camera, list[str]]:
    """Return the photograph's camera and notes about it."""
    info = photo.info
    width, height = info.width, info.height
    if focal_35mm is not None:
        # For the picture as it is, cropped or not: the user states the focal length for its angle of view.
        focal = focal_35mm / FULL_FRAME_DIAGONAL * math.hypot(width, height)
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, transfer=transfer), []
    camera = info.camera(transfer)
    if camera is not None:
        return camera, []
    told = info.focal_35mm is not None or info.focal_pixels is not None
    why = "was cut, so that EXIF's focal length says nothing" if told else "has no focal length in its EXIF"
    note = f"{photo.name} {why}: the ball is assumed to be far away (correct it by --focal-35mm)"
    return dataclasses.replace(far_camera(width, height), transfer=transfer), [note]


def _find_outline(
    photos: Sequence[Photograph], reference: Photograph, camera: Camera, ball: Sequence[float] | None
) -> BallOutline:
    """Return the ball's outline in the shown photograph, searched near its place in the best exposed one."""
    clearest = photos[_by_exposure(photos)[0]]
    if ball is not None or clearest is reference:
        return _find_ball(reference, camera, ball)
    seen = _find_ball(clearest)
    rough = _same_place((*seen.center, seen.radius), clearest.image, reference.image)
    try:
        return dataclasses.replace(find_ball(reference.image, camera, rough, NEAR), evidence=seen.evidence)
    except UsageError as problem:
        at = " ".join(f"{value:.1f}" for value in rough)
        right = f"show a brighter photograph (--shown), or give the circle of {clearest.name} (--circle {at})"
        raise UsageError(f"{reference.name} shows no rim of the ball: {right}") from problem


def _find_ball(photo: Photograph, camera: Camera | None = None, ball: Sequence[float] | None = None) -> BallOutline:
    try:
        return find_ball(photo.image, camera, ball)
    except UsageError as problem:
        raise UsageError(f"{photo.name}: {problem}") from problem


def _same_place(circle: Circle, of: Image, other: Image) -> Circle:
    """Return a ball's circle in a picture of another crop or size, at about the same relative place."""
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
    """Photographs to merge, the longest exposure first."""

    photos: tuple[Photograph, ...]
    circles: tuple[Circle, ...]
    ratios: tuple[float, ...]
    curve: Array | None
    notes: tuple[str, ...]
    is_odd: bool = False
    """True if most photographs differ from the shown one."""

    @property
    def is_deep(self) -> bool:
        """Return True if all photographs have 16 bits; else all are merged in 8 bits."""
        return all(photo.deep is not None for photo in self.photos)


def _merge_plan(
    photos: Sequence[Photograph],
    reference: Photograph,
    outline: BallOutline,
    transfer: str,
    given: Sequence[float] | Literal["pixels"] | None,
) -> _Bracket:
    """Return the photographs to merge, each with its ball's place and its exposure."""
    circle = (*outline.center, outline.radius)
    raw = [photo.is_raw for photo in photos]
    if any(raw) and transfer != "srgb":
        raise UsageError(f"--transfer {transfer}: expected none for {photos[raw.index(True)].path}, which is linear")
    if raw == [True]:
        return _Bracket((reference,), (circle,), (1.0,), None, ())
    if len(photos) == 1:
        note = f"one photograph gives no response: {transfer} is assumed; with a phone's, darks may be 3 times darker"
        return _Bracket((reference,), (circle,), (1.0,), None, (note,))
    claims: dict[str, Sequence[float] | None] = {"EXIF": exposures_by_exif(photos), "names": exposures_by_name(photos)}
    if given is not None:
        claims = {} if isinstance(given, str) else {"--exposures": given}
    told = [photo.info.exposure is not None for photo in photos]
    untold = [photo for photo, tells in zip(photos, told, strict=True) if any(told) and not tells]
    # Sort by brightness, which gives the order even if stated exposures contradict each other.
    order = sorted(range(len(photos)), key=lambda k: -float(photos[k].image[::8, ::8].mean()))
    chosen = [photos[k] for k in order]
    picked = {name: [claim[k] for k in order] for name, claim in claims.items() if claim is not None}
    rough = [_same_place(circle, reference.image, photo.image) for photo in chosen]
    aligned = align(
        [photo.image for photo in chosen], rough, next(iter(picked.values()), None), chosen.index(reference)
    )
    cut = [", and was cut or resized" * (photo.image.shape != reference.image.shape) for photo in chosen]
    notes = [
        f"{one.name} is left out: {why}{how}"
        for one, why, how in zip(chosen, aligned.strangers, cut, strict=True)
        if why
    ]
    if aligned.is_odd:
        notes.append(f"most photographs differ from {reference.name}: if it is the odd one, show another (--shown)")
    notes += [f"{photo.name} has no exposure in EXIF, so EXIF is not used" for photo in untold]
    notes += _shift_notes(chosen, aligned, rough, outline.radius)
    stay = [k for k, why in enumerate(aligned.strangers) if not why]
    soft = find_soft([aligned.patches[k] for k in stay])
    notes += [f"{chosen[stay[k]].name} is blurred: leave it out if the others show all of the light" for k in soft]
    agreed = agree_exposures(
        [aligned.patches[k] for k in stay],
        transfer,
        {name: [claim[k] for k in stay] for name, claim in picked.items()},
        [chosen[k].name for k in stay],
        known=all(raw),
    )
    first = [chosen[k] for k in stay].index(reference)
    kept, more = thin_exposures(agreed.ratios, first, [chosen[k].name for k in stay])
    return _Bracket(
        tuple(chosen[stay[k]] for k in kept),
        tuple(aligned.circles[stay[k]] for k in kept),
        tuple(agreed.ratios[k] for k in kept),
        agreed.curve,
        (*notes, *agreed.notes, *more),
        aligned.is_odd,
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
    """Merged maps of all photographs."""

    radiance: Map
    """(height, 2 height, 3), in camera values."""
    confidence: Map
    """(height, 2 height)."""
    clipped: Map
    """Share of each texel, by channel, that is clipped in every exposure; shape of ``radiance``."""
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
    """Unwrap all photographs with the pipeline's kernels and return the merged maps."""
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
            linear=bracket.is_deep,
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
    """Return the light of a map, with clipped radiance raised where an estimate exists, and notes about it."""
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
            f"clipped light was raised to a typical value, which makes {more:.0%} more light: most places have as "
            "much; an additional, shorter photograph measures it (--as-clipped leaves it out)"
        )
    if table is not None:
        radiance, said = _bounded(radiance, clipped, table, raises)
        notes += said
    emitters = find_emitters(radiance, clipped, BRACKET_ERROR, maps.radiance)
    return Light(radiance, maps.confidence, emitters, 1.0, None, share), notes


def _bounded(radiance: Map, clipped: Map, table: Table, raises: bool) -> tuple[Map, list[str]]:
    """Return a map so bright that the table's albedo is at most ``WHITEST``, and notes about it."""
    whole, bounds = irradiance_above(radiance), irradiance_above(radiance * clipped).mean()
    lacking = table.reflectance_under(whole) / WHITEST
    if lacking <= 1.0:
        return radiance, []
    note = f"the table would reflect {WHITEST * lacking:.2f} of this light, and none reflects more than {WHITEST}"
    if not raises:
        return radiance, [f"{note}: the light is too low"]
    if bounds < LEAST_CLIPPED * whole.mean():
        return lacking * radiance, [f"{note}: all light was raised {lacking:.2f} times; is --reflectance right?"]
    grow = float((lacking - 1.0) * whole.mean() / bounds)
    raised = np.asarray(radiance * (1.0 + grow * clipped), np.float32)
    return raised, [f"{note}: clipped light was raised {1.0 + grow:.2f} times"]


def _raised(radiance: Map, confidence: Map, clipped: Map) -> Map:
    """Return the map with clipped radiance raised by the least amount that is expected, (height, 2 height, 3)."""
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
) -> tuple[NDArray[Any], Pose]:
    """Return the part of a photograph around its ball, and a pose that places the ball where this part shows it.

    The ball may be displaced against the shown photograph, whose camera values the light has. The part is moved by
    whole pixels, and the rest of the displacement becomes a movement of the ball, so that no pixel is resampled.

    Args:
        bracket: Photographs of the bracket, with the circles of their balls.
        k: Index of the photograph.
        own: Circle of the ball in the shown photograph.
        window: Left column, top row and side in pixels of the part of the shown photograph.
        camera: Camera of the shown photograph.
        sphere: Centre of the ball in the shown photograph's camera frame, in radii of the ball, (3,).
        turn: Rotation from the light's axes to the camera's, (3, 3).
    """
    x0, y0, side = window
    x, y, radius = bracket.circles[k]
    dx, dy = round(x - own[0]), round(y - own[1])
    photo = bracket.photos[k]
    image = photo.deep if bracket.is_deep and photo.deep is not None else photo.image
    h, w = image.shape[:2]
    rows = np.clip(np.arange(y0 + dy, y0 + dy + side), 0, h - 1)
    columns = np.clip(np.arange(x0 + dx, x0 + dx + side), 0, w - 1)
    cut = np.ascontiguousarray(image[rows[:, None], columns])
    moved = sphere_of_circle(camera, x - dx, y - dy, radius) - sphere_of_circle(camera, *own)
    center = sphere + moved
    return cut, Pose(turn, center)
