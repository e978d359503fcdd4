"""The notebook of the docs runs from its first cell to its last, which shows a picture."""

from __future__ import annotations

import base64
import pathlib

import cv2
import numpy as np
import pytest

NOTEBOOK = pathlib.Path(__file__).parents[1] / "docs" / "desk.ipynb"

pytestmark = pytest.mark.slow


@pytest.mark.filterwarnings("ignore")  # Jupyter's own
def test_the_notebook_ends_in_a_picture() -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert len(notebook.cells) == 10
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    shown = [
        output.data["image/png"]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "data" in output and "image/png" in output.data
    ]
    assert notebook.cells[-1].outputs[-1].data["image/png"] == shown[-1]
    first, last = (cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR) for png in shown)
    assert first.shape == last.shape == (480, 640, 3)
    assert np.abs(first.astype(int) - last).max() > 40, "a mirror ball stands in the last one"
