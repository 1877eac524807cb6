"""Each figure of the pages has a recipe, and each recipe makes figures that pages show."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def figures():
    spec = importlib.util.spec_from_file_location("figures", DOCS / "figures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made = [figure for recipe in module.RECIPES.values() for figure in recipe.figures]
    assert len(made) == len(set(made))
    return {(DOCS / figure).resolve() for figure in made}


def shown():
    """Yield the figures that the pages show, and the reports that they link."""
    for page in [*DOCS.rglob("*.md"), ROOT / "README.md"]:
        if "gallery" not in page.parts:
            for name in re.findall(
                r"```\{figure\} (\S+)|!\[[^]]*\]\((\S+)\)|\]\((look/\S+\.html)\)", page.read_text()
            ):
                yield (page.parent / "".join(name)).resolve()


def test_each_figure_that_is_shown_has_a_recipe(figures):
    assert set(shown()) <= figures


def test_each_recipe_is_of_a_figure_that_is_shown(figures):
    assert figures <= set(shown())


def test_no_picture_is_without_a_page(figures):
    there = {path.resolve() for path in DOCS.rglob("*.png") if "gallery" not in path.parts}
    assert there <= figures
