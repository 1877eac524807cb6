"""The example notebook runs from its first cell to its last, and shows what it should."""

import base64
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
pytest.importorskip("ipywidgets", reason="ipywidgets are not installed")
pytest.importorskip("matplotlib")

NOTEBOOK = Path(__file__).parents[2] / "examples" / "jet.ipynb"


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """Run the notebook; return what each cell gave, by the first line of its code."""
    folder = tmp_path_factory.mktemp("notebook")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    found = {cell.source.splitlines()[-1].split(" =")[0]: cell.outputs for cell in code}
    return found | {"folder": folder, "widgets": client.widget_state}


def data(outputs, kind):
    """Return the contents of a kind that a cell gave."""
    return [each.data[kind] for each in outputs if kind in each.get("data", {})]


def pixels(page):
    """Return the thumbnail in a page, checked to be a PNG."""
    _, _, rest = page.partition("data:image/png;base64,")
    content = base64.b64decode(rest.partition("'")[0])
    assert content.startswith(b"\x89PNG")
    return content


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("observation", ("lnocl.Observation", "4 of 128 x 128 pixels", "read noise")),
        ("result", ("lnocl.Result", "held-out", "(64.00, 32.00)")),
    ],
)
def test_thumbnails_beside_tables(cells, cell, words):
    (page,) = data(cells[cell], "text/html")
    assert all(word in page for word in words)
    assert len(pixels(page)) > 500


def test_progress_is_shown(cells):
    bars = [
        state for state in cells["widgets"].values()
        if state.get("_model_name", "").endswith("FloatProgressModel")
    ]  # fmt: skip
    counted = [bar for bar in bars if bar["max"] > 1]  # others have a clock alone
    assert counted
    assert all(bar["value"] > 0 for bar in counted)


def test_the_picture_is_drawn(cells):
    (picture,) = data(cells["result.plot()"], "image/png")
    assert len(base64.b64decode(picture)) > 20_000


def test_the_table_and_the_file_are_there(cells):
    (table,) = data(cells["result.to_table()"], "text/html")
    assert "flux" in table
    assert (cells["folder"] / "jet.fits").stat().st_size > 100_000
