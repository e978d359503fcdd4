"""Pages with markers and boards that print at exact size."""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.files import store
from warp_ar.scene import CharucoBoard, Marker
from warp_ar.signature import PROGRAM, sign_png
from warp_ar.tracking.card_layout import CARD_MARKER, draw_page
from warp_ar.tracking.markers import find_dictionary, make_board

Image = NDArray[np.uint8]

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of paper in millimetres, in portrait format."""
_MARGIN = 10.0
"""Margin in millimetres at the paper's edges that printers leave blank."""


def card_size(marker: Marker) -> tuple[float, float]:
    """Return width and height in metres of a marker or board without its white margin."""
    return marker.board.size if marker.board is not None else (marker.size, marker.size)


def draw_card(marker: Marker, pixels_per_metre: float) -> Image:
    """Draw the marker or board with a white margin of at least one cell, edges rounded to whole pixels.

    Args:
        marker: what to draw.
        pixels_per_metre: resolution.

    Returns:
        Picture, uint8 (h, w), 0 or 255, with the marker in its centre.
    """
    dictionary = find_dictionary(marker.dictionary)
    bits = int(dictionary.markerSize) + 2
    width, height = card_size(marker)
    side, board = marker.size, marker.board
    places: list[tuple[int, float, float]] = [(marker.id, 0.0, 0.0)]
    if board is not None:
        made, side = make_board(marker), board.marker_length
        places = [
            (int(number), float(corners[0][0]), float(corners[0][1]))
            for number, corners in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True)
        ]
    margin = max(side / bits, 0.005)
    image = np.full([round((length + 2 * margin) * pixels_per_metre) for length in (height, width)], 255, np.uint8)

    def fill(cells: NDArray[Any], left: float, top: float, size: float) -> None:
        rows, columns = (
            np.round((margin + start + size * np.arange(count + 1)) * pixels_per_metre).astype(int)
            for start, count in zip((top, left), cells.shape, strict=True)
        )
        image[rows[0] : rows[-1], columns[0] : columns[-1]] = np.repeat(
            np.repeat(cells, np.diff(rows), axis=0), np.diff(columns), axis=1
        )

    if isinstance(board, CharucoBoard):
        squares = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
        fill((255 * squares).astype(np.uint8), 0.0, 0.0, board.square_length)
    for number, left, top in places:
        fill(np.asarray(cv2.aruco.generateImageMarker(dictionary, number, bits, borderBits=1)), left, top, side / bits)
    return image


def write_card(marker: Marker, path: Path, paper: str = "a4", dpi: float = 600.0) -> None:
    """Write a page that prints at true size, as PDF or PNG by the suffix.

    Args:
        marker: Marker to print; ``CARD_MARKER`` gives the whole card, others get their name and a bar of 100 mm.
        path: The file.
        paper: A name of ``PAPERS``.
        dpi: Dots per inch.

    Raises:
        UsageError: The card does not fit on the paper, or the path has another suffix.
        SinkError: The file cannot be written.
    """
    if paper not in PAPERS:
        raise UsageError(f"--paper {paper}: expected {', '.join(PAPERS)}")
    if not 72 <= dpi <= 2400:
        raise UsageError(f"--dpi {dpi:g}: expected 72 to 2400 dots per inch")
    if path.suffix.lower() not in (".pdf", ".png"):
        raise UsageError(f"--output {path}: expected a name that ends in .pdf or .png")
    # PNG stores whole pixels per metre: with that resolution, the print is exact.
    per_metre = round(dpi / 0.0254)
    if marker == CARD_MARKER:
        width, height = PAPERS[paper]
        page = draw_page((width / 1e3, height / 1e3), per_metre, draw_card(marker, per_metre))
    else:
        page = _draw_page(marker, paper, per_metre)
    store(path, _pdf(page, per_metre) if path.suffix.lower() == ".pdf" else _png(page, per_metre))


def _draw_page(marker: Marker, paper: str, per_metre: int) -> Image:
    """Draw a page with a marker or board, its name, and a bar of 100 mm to check the printer."""
    width, height = PAPERS[paper]
    card_mm = [1e3 * length for length in card_size(marker)]
    foot = 15.0
    if card_mm[0] > card_mm[1]:
        width, height = height, width
    if card_mm[0] > width - 2 * _MARGIN or card_mm[1] > height - 2 * _MARGIN - foot:
        raise UsageError(
            f"card of {card_mm[0]:g} x {card_mm[1]:g} mm does not fit on {paper} ({width:g} x {height:g} mm "
            "with margins); choose smaller lengths or a larger --paper"
        )
    mm = per_metre / 1e3
    page = np.full((round(height * mm), round(width * mm)), 255, np.uint8)
    card = draw_card(marker, per_metre)
    h, w = (min(a, b) for a, b in zip(card.shape, page.shape, strict=True))
    card = card[(card.shape[0] - h) // 2 :, (card.shape[1] - w) // 2 :][:h, :w]
    y, x = (page.shape[0] - round(foot * mm) - h) // 2, (page.shape[1] - w) // 2
    page[y : y + h, x : x + w] = card
    bottom = page.shape[0] - round(_MARGIN * mm)
    page[bottom - round(mm) : bottom, round(_MARGIN * mm) : round(_MARGIN * mm) + round(100 * mm)] = 0
    name = str(marker.board) if marker.board is not None else f"id {marker.id}, {marker.size:g} m"
    text = f"{marker.dictionary}, {name}; print at 100 %: this bar is 100 mm"
    place = (round(_MARGIN * mm), bottom - round(3 * mm))
    cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, mm / 9, 0, max(1, round(mm / 5)), cv2.LINE_AA)
    return page


def _png(page: Image, per_metre: int) -> bytes:
    density = (per_metre * 0.0254, per_metre * 0.0254)
    out = io.BytesIO()
    PIL.Image.fromarray(page).save(out, "png", dpi=density)
    return sign_png(out.getvalue())


def _pdf(page: Image, per_metre: int) -> bytes:
    """Return a page with one bit per pixel as PDF 1.4 with exactly the paper size of its pixels."""
    rows, columns = page.shape
    width, height = (length / per_metre / 0.0254 * 72 for length in (columns, rows))
    bits = zlib.compress(np.packbits(page > 127, axis=1).tobytes(), 9)
    contents = f"{width:.5f} 0 0 {height:.5f} 0 0 cm /Card Do".encode()
    image = f"/Type /XObject /Subtype /Image /Width {columns} /Height {rows} /ColorSpace /DeviceGray"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.5f} {height:.5f}] /Contents 4 0 R "
        "/Resources << /XObject << /Card 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(contents), contents),
        f"<< {image} /BitsPerComponent 1 /Filter /FlateDecode /Length {len(bits)} >>\nstream\n".encode()
        + bits
        + b"\nendstream",
    ]
    # The second line marks the file as binary; the third is this program's signature.
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n% " + PROGRAM.encode() + b"\n")
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    start, count = len(out), len(objects) + 1
    trailer = f"trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n"
    return bytes(out) + f"xref\n0 {count}\n0000000000 65535 f \n{table}{trailer}".encode()
