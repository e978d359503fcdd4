"""Error of irradiance with clipped light, and with clipped light raised by one number, over a folder of environments.

    python -m bench clipping_prior --folder=FOLDER    # FOLDER/*.hdr: latlong, unclipped

Each map is clipped as by a camera that looks slightly below its horizon and meters the mean of its frame to 18 %, with
an offset of some stops. Errors are relative, of irradiance over directions and channels, for:

- ``clipped``: the clipped map;
- each of ``NUMBERS``: radiance added where the map clips, in units of the clipping level;
- ``best``: the number that is best for each picture;
- ``least``: the program's prior without any other evidence (``priors.least_missing``);
- ``stops_N``: a map that clips N stops later, as in a second, shorter photograph.

``allowed`` are quantiles of the largest ``LeastConfig.least`` with which an exposure does not become worse. The result
is one JSON line.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.table_world import latlong_directions
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS
from warp_ar.light.captured import texel_solid_angles
from warp_ar.light.config import CONFIG
from warp_ar.light.evidence import spread_directions
from warp_ar.light.priors import least_missing

Map = NDArray[np.float32]

NUMBERS: Final = (0.5, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)
"""Radiance added to a wholly clipped texel, in units of the clipping level."""
SHORTER: Final = (2, 4, 6)
"""Numbers of stops by which a second photograph is shorter."""
GREY: Final = 0.18
"""Mean radiance of a metered frame, relative to the clipping level."""
FRAME: Final = (45.0, 60.0)
"""Height and width of the frame in degrees; its upper edge is 10 degrees above the horizon."""
WORSE: Final = 1.02
"""Ratio of errors above which a picture counts as worse."""


@functools.cache
def _form() -> NDArray[np.float32]:
    """Return the matrix from the radiance of a map of 64 rows to irradiance in 64 directions, (64, 8192)."""
    d, area = latlong_directions(64, 128)
    cosine = np.maximum(spread_directions(64) @ d.reshape(-1, 3).T, 0.0)
    return np.asarray(cosine * area.reshape(-1), np.float32)


def irradiance(radiance: Map) -> NDArray[np.float64]:
    """Return the irradiance of a latlong map (h, 2 h, 3) in 64 directions, (64, 3)."""
    small = cv2.resize(radiance, (128, 64), interpolation=cv2.INTER_AREA)
    return np.asarray(_form() @ small.reshape(-1, 3), np.float64)


def metered_level(radiance: Map, column: int, stops: float) -> float:
    """Return the radiance at which a camera clips that meters a frame of a latlong map.

    Args:
        radiance: Latlong map, (h, 2 h, 3).
        column: Left edge of the frame.
        stops: Number of stops by which the exposure is shorter than metered.
    """
    rows, columns = radiance.shape[:2]
    top, bottom = (round(rows * (90.0 + angle) / 180.0) for angle in (-10.0, FRAME[0] - 10.0))
    frame = np.roll(radiance, -column, axis=1)[top:bottom, : round(columns * FRAME[1] / 360.0)]
    return float(max(float(frame.mean()), 1e-9) / GREY * 2.0**stops)


def raise_clipped(radiance: Map, clipped: NDArray[np.bool_]) -> Map:
    """Return a clipped map in which clipped light is raised by ``least_missing``.

    Args:
        radiance: Clipped map, (h, 2 h, 3).
        clipped: Mask of clipped channels, (h, 2 h, 3).
    """
    share = clipped.astype(np.float32)
    cells = [cv2.resize(one, (CELL_COLUMNS, CELL_ROWS), interpolation=cv2.INTER_AREA) for one in (radiance, share)]
    area = np.broadcast_to(texel_solid_angles(CELL_ROWS), (CELL_ROWS, CELL_COLUMNS))
    least = least_missing(*cells, area, np.ones(area.shape, bool))
    wide = cv2.resize(least, radiance.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(radiance + share * wide, np.float32)


def errors_of(radiance: Map, level: float) -> dict[str, float]:
    """Return the relative errors of irradiance for one exposure of a map.

    Args:
        radiance: Latlong map, (h, 2 h, 3).
        level: Radiance at which all channels clip.

    Returns:
        Errors by the names that the module lists; ``allowed``, the largest allowed ``LeastConfig.least``; and
        ``missing``, the mean missing radiance of clipped light in units of the level, by the missing irradiance.
    """
    truth, clipped = irradiance(radiance), irradiance(np.minimum(radiance, level))
    unit = irradiance((radiance >= level).astype(np.float32) * np.float32(level))
    missing, size = truth - clipped, max(float(np.linalg.norm(truth)), 1e-12)
    best = max(float((unit * missing).sum()) / max(float((unit * unit).sum()), 1e-12), 0.0)

    def error(added: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(missing - added)) / size

    raised = irradiance(raise_clipped(np.minimum(radiance, level), radiance >= level)) - clipped
    squared = float((raised * raised).sum())
    allowed = 2.0 * CONFIG.least.least * float((raised * missing).sum()) / squared if squared > 0.0 else np.inf
    found = {"clipped": error(0.0 * unit), "best": error(best * unit), "least": error(raised), "allowed": allowed}
    found |= {str(number): error(number * unit) for number in NUMBERS}
    for stops in SHORTER:
        found[f"stops_{stops}"] = error(irradiance(np.minimum(radiance, level * 2.0**stops)) - clipped)
    return {**found, "missing": float(missing.sum() / max(float(unit.sum()), 1e-12))}


def summarise(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return the printed figures over all exposures.

    Args:
        rows: Result of ``errors_of`` for each exposure.

    Returns:
        ``error``: mean error of each rule, such as ``clipped``. ``worse``: share of the exposures whose error the rule
        raises above ``WORSE`` times that of the clipped map. ``missing`` and ``allowed``: quantiles of these values.
    """
    others = ("missing", "allowed")
    means = {key: round(float(np.mean([row[key] for row in rows])), 3) for key in rows[0] if key not in others}
    worse = {
        key: round(float(np.mean([row[key] > WORSE * row["clipped"] + 1e-4 for row in rows])), 3)
        for key in ("least", *map(str, NUMBERS))
    }
    allowed = np.quantile([row["allowed"] for row in rows], [0.002, 0.01, 0.02], method="lower")
    missing = np.quantile([row["missing"] for row in rows], [0.025, 0.25, 0.5, 0.75, 0.975])
    return {
        "exposures": len(rows),
        "error": means,
        "worse": worse,
        "missing": [round(float(q), 2) for q in missing],
        "allowed": [round(float(q), 2) for q in allowed],
    }


def main(device: str, arguments: Sequence[str] = ()) -> None:
    """Measure all maps of a folder and print one JSON line; nothing runs on the device."""
    parser = argparse.ArgumentParser(prog="python -m bench clipping_prior", description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, help="a folder of latlong .hdr files")
    parser.add_argument("--stops", type=float, default=1.0, help="largest offset to metering, to either side")
    parser.add_argument("--exposures", type=int, default=4, help="of each map")
    options = parser.parse_args(list(arguments))
    paths = [] if options.folder is None else sorted(options.folder.glob("*.hdr"))
    if not paths:
        print("bench clipping_prior: expected a folder that holds latlong .hdr files")
        return
    rng, rows = np.random.default_rng(0), []
    for path in paths:
        radiance = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if radiance is None or radiance.ndim != 3 or radiance.shape[1] != 2 * radiance.shape[0]:
            print(f"{path.name} is left out: it is no latlong map, twice as wide as high")
            continue
        radiance = np.clip(np.nan_to_num(radiance.astype(np.float32), posinf=1e6, neginf=0.0), 0.0, 1e6)
        for _ in range(options.exposures):
            column, stops = int(rng.integers(radiance.shape[1])), float(rng.uniform(-options.stops, options.stops))
            rows.append(errors_of(radiance, metered_level(radiance, column, stops)))
    if rows:
        print(json.dumps({"bench": "clipping_prior", "maps": len(paths), **summarise(rows)}))
