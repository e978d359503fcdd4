"""Figures 1 and 3 to 9 of [DH04] from bundled clips: the paper's own method, ours, and the truth.

Figure 2 is a photograph of the mirror ball on its marker, which every bundled clip shows.

References:
    [DH04] DiVerdi, Hoellerer, "Combining Dynamic Physical and Virtual Illumination in Augmented Reality", 2004.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.cases import Case, Image, Mask, open_scene
from warp_ar.accuracy.charts import Point, lines, scatter
from warp_ar.accuracy.cost_table import turn
from warp_ar.accuracy.measure import picture_error, region_of, run, run_in_turn
from warp_ar.accuracy.metrics import flip_map
from warp_ar.accuracy.pictures import Box, bounding_box, crop, error_colors
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.color import decode_table
from warp_ar.light.captured import texel_solid_angles
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.stages.quality import PRESETS, Quality

OURS = ("medium", "high")
"""Presets that are compared with the paper's method."""
GRID = 0.05
"""Distance in metres between the lines of the ground plane in figure 5."""
FULL = 0.4
"""Share of the brightest added light above which a pixel is well inside the light's cone."""
GAP = 6
"""Distance in pixels between the pictures of a sheet."""
CARD = 0.85
"""Half the side of a printed card, relative to the side of its marker."""
BAND = 2
"""Number of rows above and below a profile's row over which it is averaged."""
NORMALS = (24, 48)
"""Rows and columns of the normals at which irradiance is compared."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear RGB in luminance."""


@dataclasses.dataclass(frozen=True)
class Context:
    """Settings of all figures."""

    device: str
    """``cpu`` or ``cuda:N``."""
    count: int = 12
    """Largest number of frames of a case; the last is shown."""
    times: int = 1
    """Integer factor by which frames are reduced."""

    def case(self, name: str) -> Case:
        """Return the case of a bundled scene; its last frame is the one with a true picture."""
        return open_scene(name, self.count, self.times)


@dataclasses.dataclass(frozen=True)
class PaperFigure:
    """Figure with its picture, its numbers and its plots."""

    number: int
    """Number in the paper."""
    title: str
    """Title."""
    text: str
    """Description, with the section of the paper."""
    labels: tuple[str, ...]
    """Labels of the picture's columns."""
    picture: Image
    """Sheet of pictures."""
    head: tuple[str, ...]
    """Names of the table's columns."""
    rows: tuple[tuple[str, ...], ...]
    """Rows of the table of numbers."""
    plots: tuple[str, ...]
    """Plots as SVG."""


def sheet(columns: Sequence[Image], reference: Image | None, box: Box) -> Image:
    """Return one picture with crops side by side and, if there is a reference, their FLIP to it below.

    Args:
        columns: Pictures.
        reference: Picture with which they are compared, or None.
        box: Part of the pictures to crop.
    """
    rows = [[crop(image, box) for image in columns]]
    if reference is not None:
        errors = [error_colors(flip_map(reference, image)) for image in columns]
        rows.append([crop(error, box) for error in errors])
    tall, wide = rows[0][0].shape[:2]
    size = len(rows) * (tall + GAP) - GAP, len(columns) * (wide + GAP) - GAP
    out = np.full((*size, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, image in enumerate(row):
            out[i * (tall + GAP) :, j * (wide + GAP) :][:tall, :wide] = image
    return out


def halves(first: Image, second: Image, box: Box, *, above: bool) -> Image:
    """Return ``second`` with the upper half of a box (if ``above``; else the left half) replaced by ``first``."""
    out = second.copy()
    rows, columns = box
    if above:
        out[: (rows.start + rows.stop) // 2] = first[: (rows.start + rows.stop) // 2]
    else:
        out[:, : (columns.start + columns.stop) // 2] = first[:, : (columns.start + columns.stop) // 2]
    return out


# ------------------------------------------------------------------------------------------------------ whole pictures


def _compare(
    context: Context,
    number: int,
    scene: str,
    title: str,
    text: str,
    *,
    plain: Mapping[str, str] | None = None,
    above: bool | None = None,
) -> PaperFigure:
    """Return a figure that compares the camera's frame, the preset ``paper``, our presets and the truth.

    Times are processor time of all threads, on which other programs have little effect.

    Args:
        context: Settings of all figures.
        number: Number of the figure.
        scene: Name of the bundled scene.
        title: Title of the figure.
        text: Description of the figure.
        plain: Methods that turn the preset ``paper`` into the usual method, which the paper shows for comparison.
        above: Halves of the picture that shows the usual and the paper's method: True: upper and lower; False: left and
            right; None: the usual method is not shown.
    """
    case = context.case(scene)
    qualities = {"plain": turn(PRESETS["paper"], plain)} if plain else {}
    qualities |= {"paper": PRESETS["paper"], **{name: PRESETS[name] for name in OURS}}
    times, images = run_in_turn(case, qualities, context.device, time.process_time)
    index = case.shown[-1]
    camera, truth = case.frames[index].image, case.truth[index]
    region = region_of(case, index, truth)
    box = bounding_box(region, camera.shape[:2])
    columns = {"camera": camera}
    if plain and above is not None:
        columns["plain | paper"] = halves(images["plain"][index], images["paper"][index], box, above=above)
    else:
        columns["paper"] = images["paper"][index]
    columns |= {name: images[name][index] for name in OURS} | {"truth": truth}
    found = [
        (
            label,
            statistics.median(times[label]),
            picture_error(case, case.truth, images[label]),
            kept_error(camera, truth, images[label][index], region),
        )
        for label in qualities
    ]
    rows = tuple((label, f"{ms:.1f}", f"{flip:.3f}", f"{kept:.0%}") for label, ms, flip, kept in found)
    points = [
        Point(label, ms, flip, any(m <= ms and f <= flip and other != label for other, m, f, _ in found))
        for label, ms, flip, _ in found
    ]
    plot = scatter(points, "milliseconds of work per frame", "FLIP to the truth, per changed pixel")
    head = ("quality", "ms per frame", "FLIP to the truth", "error kept")
    picture = sheet(list(columns.values()), truth, box)
    return PaperFigure(number, title, text, tuple(columns), picture, head, rows, (plot,))


def kept_error(camera: Image, truth: Image, image: Image, region: Mask) -> float:
    """Return the mean difference between a picture and the truth in a region, divided by that of the camera's frame."""
    asked = np.abs(camera.astype(float) - truth)[region].mean()
    return float(np.abs(image.astype(float) - truth)[region].mean() / max(asked, 1e-9))


def figure_1(context: Context) -> PaperFigure:
    """Return figure 1: a gold teapot and a blue spotlight."""
    text = (
        "A virtual teapot of gold, lit by the environment and by a blue spotlight that falls on the physical table too "
        "(sections 3 and 4)."
    )
    return _compare(context, 1, "desk", "A virtual teapot and spotlight", text)


def figure_4(context: Context) -> PaperFigure:
    """Return figure 4: a torus."""
    text = "A torus of unpolished gold, lit by the physical environment alone (section 3.3)."
    return _compare(context, 4, "torus", "A virtual torus in the physical environment", text)


def figure_7(context: Context) -> PaperFigure:
    """Return figure 7: half the exposure."""
    text = (
        "A scene darkened to 50 percent (section 4.3). Left half of the second picture: brightness alone, right half: "
        "the paper's. FLIP and kept error are of pixels that clip."
    )
    more: dict[str, Any] = {"plain": {"expose": "plain"}, "above": False}
    return _compare(context, 7, "darken", "A shorter exposure", text, **more)


def figure_8(context: Context) -> PaperFigure:
    """Return figure 8: a wire under a light that coincides with the physical one."""
    text = (
        "A spotlight from where the physical light comes (section 4.4). Upper half of the second picture: alpha "
        "blending, lower half: the paper's shader."
    )
    more: dict[str, Any] = {"plain": {"relight": "flat"}, "above": True}
    return _compare(context, 8, "wire_coincident", "A coincident virtual light", text, **more)


def figure_9(context: Context) -> PaperFigure:
    """Return figure 9: a wire under a light that opposes the physical one."""
    text = (
        "The same spotlight against the physical light (section 4.4): highlights stay white, shadows become "
        "illuminated. Upper half of the second picture: alpha blending, lower half: the paper's shader."
    )
    more: dict[str, Any] = {"plain": {"relight": "flat"}, "above": True}
    return _compare(context, 9, "wire_opposing", "An opposing virtual light", text, **more)


# ------------------------------------------------------------------------------------------------------ the environment


def _maps(context: Context, case: Case, quality: Quality) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the environment map and the irradiance map, at ``NORMALS``, after a case's frames."""
    maps: dict[str, npt.NDArray[Any]] = {}

    def keep(pipeline: Pipeline) -> None:
        for name in ("environment", "irradiance_map"):
            if name in pipeline.arrays:
                maps[name] = pipeline.arrays[name].numpy().astype(np.float64)

    # The paper's filter does not read the environment map, so the map is taken from a run with another filter.
    for shown in (turn(quality, {"irradiance": "clusters"}), quality):
        run(case, {"": shown}, context.device, keep=keep)
    return maps["environment"], cv2.resize(maps["irradiance_map"], NORMALS[::-1], interpolation=cv2.INTER_LINEAR)


def _shown(radiance: npt.NDArray[Any], size: tuple[int, int]) -> Image:
    """Return a linear map as a picture of a height and width, with repeated texels."""
    codes = (np.clip(radiance, 0.0, 1.0) ** (1.0 / 2.2) * 255.0 + 0.5).astype(np.uint8)
    rows = np.arange(size[0]) * codes.shape[0] // size[0]
    columns = np.arange(size[1]) * codes.shape[1] // size[1]
    return np.ascontiguousarray(codes[rows][:, columns])


def figure_3(context: Context) -> PaperFigure:
    """Return figure 3: the environment map and its filtered form."""
    case = context.case("torus")
    size = (180, 360)
    found = {name: _maps(context, case, PRESETS[name]) for name in ("paper", "high")}
    # The exact result of filtering the paper's environment is the convolution with the cosine lobe.
    exact = turn(PRESETS["paper"], {"irradiance": "brute_force"})
    _, lobe = _maps(context, case, exact)
    columns = {
        "paper: environment": _shown(found["paper"][0], size),
        "paper: diffuse": _shown(found["paper"][1] / np.pi, size),
        "ours: environment": _shown(found["high"][0], size),
        "ours: diffuse": _shown(found["high"][1] / np.pi, size),
    }
    rows = []
    for name, (environment, irradiance) in found.items():
        weights = texel_solid_angles(len(environment))[..., None]
        mean = (environment * weights).sum((0, 1)) / (weights.sum() * environment.shape[1])
        area = texel_solid_angles(NORMALS[0])[..., None]
        off = np.sqrt((area * (irradiance - lobe) ** 2).sum() / (area * lobe**2).sum())
        error = f"{off:.1%}" if name == "paper" else ""
        values = (mean @ _LUMINANCE, (environment @ _LUMINANCE).max(), irradiance[0].mean(0) @ _LUMINANCE)
        rows.append((name, *(f"{value:.3f}" for value in values), error))
    degrees = (np.arange(NORMALS[1]) + 0.5) / NORMALS[1] * 360.0 - 180.0
    middle = NORMALS[0] // 2
    series = [
        ("paper: a coarse level", degrees, found["paper"][1][middle] @ _LUMINANCE),
        ("the same light through the cosine lobe", degrees, lobe[middle] @ _LUMINANCE),
        ("ours, with clipped light put back", degrees, found["high"][1][middle] @ _LUMINANCE),
    ]
    plot = lines(series, "azimuth of a vertical surface's normal, degrees", "irradiance")
    box = slice(0, size[0]), slice(0, size[1])
    head = ("quality", "mean radiance", "largest radiance", "irradiance upward", "diffuse map, off its cosine lobe")
    text = (
        "Left: the acquired environment map; right: the filtered map for diffuse lighting (sections 3.1 and 3.2). The "
        "paper's environment is clipped as the camera clips, and its diffuse map is a coarse level of the ball's "
        "picture, with the background that surrounds it."
    )
    picture = sheet(list(columns.values()), None, box)
    return PaperFigure(3, "Environment maps", text, tuple(columns), picture, head, tuple(rows), (plot,))


# ---------------------------------------------------------------------------------------------------- the bumpy surface


def _luminance(case: Case, image: Image) -> npt.NDArray[np.float64]:
    """Return the linear luminance of a picture by the camera's transfer function."""
    table = decode_table(case.scene.camera.transfer).astype(np.float64)
    linear = np.stack([table[image[..., k], k] for k in range(3)], -1)
    return np.asarray(linear @ _LUMINANCE)


def _plane_points(case: Case, index: int) -> tuple[npt.NDArray[np.float64], Mask]:
    """Return the points of the first proxy, a plane, at the pixels of a frame, and a mask of the pixels that show it.

    Returns:
        x and y in metres, (H, W, 2); and the mask, (H, W).
    """
    pose, plane = case.poses[index], case.scene.proxies[0]
    assert pose is not None
    rays = pixel_rays(case.scene.camera).astype(np.float64)
    world = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) @ pose.rotation
    position = -pose.rotation.T @ pose.translation
    reach = (plane.at[2] - position[2]) / world[..., 2]
    points = (position + reach[..., None] * world)[..., :2]
    return points, np.asarray((reach > 0.0) & (np.abs(points) < 0.5 * np.asarray(plane.size)).all(-1))


def _lit_region(case: Case, index: int) -> Mask:
    """Return a mask of the pixels well inside the virtual light's cone, with holes closed.

    The edge of the cone is excluded, because it would count as structure of the surface.
    """
    gain = _luminance(case, case.truth[index]) - _luminance(case, case.frames[index].image)
    size = max(gain.shape[0] // 30, 3)
    smooth = cv2.GaussianBlur(gain, (0, 0), 0.3 * size)
    lit = (smooth > FULL * np.quantile(smooth, 0.99)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(lit, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)) > 0)


def _profile_row(case: Case, index: int, region: Mask) -> tuple[int, slice]:
    """Return the row of a frame, with a range of columns, on which brightness in a region varies most.

    This row crosses the wire. Only pixels to the right of the printed card are used, because the card's pattern is not
    due to light.
    """
    points, _ = _plane_points(case, index)
    card = (np.abs(points) < CARD * case.scene.marker.size).all(-1)
    region = region.copy()
    region[:, : np.nonzero(card.any(0))[0][-1] + 1] = False
    luminance = _luminance(case, case.frames[index].image)
    widths = region.sum(1)
    rows = np.nonzero(widths >= max(0.7 * widths.max(), 8))[0]
    best = max(rows, key=lambda row: luminance[row][region[row]].std() / luminance[row][region[row]].mean())
    columns = np.nonzero(region[best])[0]
    trim = (columns[-1] - columns[0]) // 8
    return int(best), slice(int(columns[0] + trim), int(columns[-1] - trim))


def _band(values: npt.NDArray[np.float64], row: int, columns: slice) -> npt.NDArray[np.float64]:
    return np.asarray(values[max(row - BAND, 0) : row + BAND + 1, columns].mean(0))


def figure_5(context: Context) -> PaperFigure:
    """Return figure 5: the physical scene and its model."""
    case = context.case("wire_coincident")
    index = case.shown[-1]
    camera = case.frames[index].image
    points, inside = _plane_points(case, index)
    cells = np.floor(points / GRID).astype(int)
    edges = np.zeros(inside.shape, bool)
    edges[:, 1:] |= (cells[:, 1:] != cells[:, :-1]).any(-1)
    edges[1:] |= (cells[1:] != cells[:-1]).any(-1)
    model = camera.copy()
    model[edges & inside] = (40, 110, 230)
    flat = turn(PRESETS["paper"], {"relight": "flat"})
    shown = run(case, {"": flat}, context.device)[""][index]
    region = region_of(case, index, case.truth[index])
    row, columns = _profile_row(case, index, _lit_region(case, index))
    before = _luminance(case, camera)
    knows = _band(_luminance(case, shown) - before, row, columns)
    sees = _band(before, row, columns)
    x = np.arange(columns.start, columns.stop)
    series = [("camera", x, sees / sees.mean()), ("light on the model", x, knows / max(knows.mean(), 1e-9))]
    rows = tuple(
        (name, f"{_structure(values):.1%}") for name, values in (("camera", sees), ("light on the model", knows))
    )
    text = (
        "A table, modelled by a ground plane, of which the lines are 5 cm apart; the wire on it is in no model "
        "(section 4.1). The plot runs across the wire: the frame has structure that light on the plane has not."
    )
    box = bounding_box(region, camera.shape[:2])
    return PaperFigure(
        5,
        "The scene and its model",
        text,
        ("camera", "model: a plane", "alpha blending"),
        sheet([camera, model, shown], None, box),
        ("what", "structure along the profile (RMS about its trend)"),
        rows,
        (lines(series, f"column, row {row}", "brightness over its mean"),),
    )


def _structure(values: npt.NDArray[np.float64]) -> float:
    """Return the RMS of relative deviations from a parabola, which approximates the falloff of light."""
    x = np.linspace(-1.0, 1.0, len(values))
    trend = np.polyval(np.polyfit(x, values, 2), x)
    return float(np.sqrt(np.mean((values / np.maximum(trend, 1e-6) - 1.0) ** 2)))


def figure_6(context: Context) -> PaperFigure:
    """Return figure 6: intensity profiles across the wire."""
    pictures: list[Image] = []
    line: tuple[int, slice] | None = None  # both clips have the same frame, so one line serves for both
    rows, plots = [], []
    for scene, where in (("wire_coincident", "coincident"), ("wire_opposing", "opposing")):
        case = context.case(scene)
        index = case.shown[-1]
        camera, truth = case.frames[index].image, case.truth[index]
        region = region_of(case, index, truth)
        if line is None:
            line = _profile_row(case, index, _lit_region(case, index))
        row, columns = line
        shown = {"truth": truth}
        qualities = {
            "alpha blending": turn(PRESETS["paper"], {"relight": "flat"}),
            "paper": PRESETS["paper"],
            "high": PRESETS["high"],
        }
        shown |= {label: own[index] for label, own in run(case, qualities, context.device).items()}
        before = _luminance(case, camera)
        physical = _band(before, row, columns)
        added = {label: _band(_luminance(case, image) - before, row, columns) for label, image in shown.items()}
        flat = np.maximum(added["alpha blending"], 1e-6)
        x = np.arange(columns.start, columns.stop)
        series = [("physical light (the frame)", x, physical / physical.mean())]
        series += [(label, x, added[label] / flat) for label in ("truth", "paper", "high")]
        plots.append(lines(series, f"column, row {row}", f"{where}: light added, over what alpha blending adds"))
        rows += [
            (
                f"{where}, {label}",
                f"{np.corrcoef(_detail(physical), _detail(added[label] / flat))[0, 1]:+.2f}",
                f"{(added[label] / flat).mean():.2f}",
            )
            for label in ("truth", "paper", "high")
        ]
        box = bounding_box(region, camera.shape[:2])
        marked = camera.copy()
        marked[row, columns] = (230, 60, 40)
        pictures.append(sheet([marked, shown["paper"], shown["high"], truth], None, box))
    wide = min(picture.shape[1] for picture in pictures)
    text = (
        "For a coincident virtual light the surface's highlights and shadows are those of the physical light; for an "
        "opposing one they are inverted (section 4.2). Along the red line: the frame's own brightness, and the light "
        "that each method adds over what alpha blending adds. The correlation of both is what the figure is about."
    )
    head = ("light", "correlation with the frame's structure", "mean over alpha blending")
    picture = np.concatenate([picture[:, :wide] for picture in pictures])
    labels = ("camera", "paper", "high", "truth")
    return PaperFigure(6, "Intensity across a bump", text, labels, picture, head, tuple(rows), tuple(plots))


def _detail(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a profile minus its trend, a parabola."""
    x = np.linspace(-1.0, 1.0, len(values))
    return np.asarray(values - np.polyval(np.polyfit(x, values, 2), x))


FIGURES: Mapping[int, Callable[[Context], PaperFigure]] = MappingProxyType(
    {
        1: figure_1,
        3: figure_3,
        4: figure_4,
        5: figure_5,
        6: figure_6,
        7: figure_7,
        8: figure_8,
        9: figure_9,
    }
)
"""Functions that make the figures, by number."""


# -------------------------------------------------------------------------------------------------------- open readings


@dataclasses.dataclass(frozen=True)
class Reading:
    """One interpretation of a statement that the paper leaves open."""

    section: str
    """Section of the paper."""
    question: str
    """Quantity that is left open."""
    answer: str
    """Interpretation."""
    methods: Mapping[str, str]
    """Methods that differ from those of the preset ``paper``."""
    video: bool = False
    """True if everything is computed in video values, as if the camera were linear."""


_BLEND = "what the multiplicative factor is taken from"
_EXACT = {"unwrap": "area", "irradiance": "sh2", "prefilter": "energy_mip"}
READINGS: tuple[Reading, ...] = (
    Reading("3.1", "the environment map", "OpenGL's sphere map, boxes over its texture (taken)", {}),
    Reading("3.1", "the environment map", "exact places on the ball, spherical harmonics, mixed mips", _EXACT),
    Reading("4.2", _BLEND, "video values, light added in linear light (taken)", {}),
    Reading("4.2", _BLEND, "linear luminance", {"relight": "paper_linear"}),
    Reading("4.2", _BLEND, "video values, everything else in video values too", {}, video=True),
    Reading("4.2", "a light that opposes", "the inverse, as the text says (taken)", {}),
    Reading("4.2", "a light that opposes", "the shader's lerp as printed", {"relight": "paper_shader"}),
    Reading("4.4", "several physical lights", "one is assumed, the brightest (taken)", {}),
    Reading("4.4", "several physical lights", "alpha fades with their balance", {"relight": "paper_weighted"}),
    Reading("4.3", "the factor", "s + (1 - s) clamp(2 a - 1, 0, 1) (taken)", {}),
    Reading("4.3", "the factor", "s + (1 - s) a", {"expose": "paper_mean"}),
)
"""Interpretations that ``docs/paper.md`` compares."""
READING_SCENES = ("desk", "torus", "wire_coincident", "wire_opposing", "darken")
"""Scenes on which ``docs/paper.md`` compares them."""


def compare_readings(
    context: Context, scenes: Sequence[str] = READING_SCENES
) -> list[tuple[Reading, dict[str, float]]]:
    """Return each interpretation with its FLIP to the truth by scene, without the scenes that it does not affect."""
    found: list[tuple[Reading, dict[str, float]]] = [(reading, {}) for reading in READINGS]
    for scene in scenes:
        case = context.case(scene)
        known: dict[tuple[Any, ...], float] = {}
        for reading, errors in found:
            if not _matters(reading, case):
                continue
            key = (*sorted(reading.methods.items()), reading.video)
            if key not in known:
                known[key] = _reading_error(context, case, reading)
            errors[scene] = known[key]
    return found


def _matters(reading: Reading, case: Case) -> bool:
    """Return True if an interpretation affects the picture of a case."""
    if reading.section == "4.3":
        return case.darker
    return bool(case.scene.objects if reading.section == "3.1" else case.scene.lights) and not case.darker


def _reading_error(context: Context, case: Case, reading: Reading) -> float:
    quality = PRESETS["paper"].with_methods(**reading.methods)
    read = case
    if reading.video:
        camera = dataclasses.replace(case.scene.camera, transfer="linear")
        read = dataclasses.replace(case, scene=dataclasses.replace(case.scene, camera=camera))
    images = run(read, {"": quality}, context.device)[""]
    return picture_error(case, case.truth, images)
