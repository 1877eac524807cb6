"""The reference has every public name, and each of them an example that runs as a doctest."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import lnocl
from lnocl import detection, metrics, psf, simulation

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"


def documented():
    """Yield module and name of all that the pages of the reference list."""
    for page in sorted(REFERENCE.glob("*.rst")):
        module = "lnocl"
        for line in page.read_text().splitlines():
            if named := re.match(r"\.\. currentmodule:: (\S+)", line):
                module = named[1]
            elif entry := re.match(r"(?:   |\.\. autoexception:: )([A-Za-z_][\w.]*)$", line):
                yield module, entry[1]


def find(module, name):
    """Return an object by its name in a module, or by its whole name."""
    whole = name if name.startswith("lnocl.") else f"{module}.{name}"
    home, _, last = whole.rpartition(".")
    return getattr(importlib.import_module(home), last)


NAMES = sorted(set(documented()))


@pytest.mark.parametrize(("module", "name"), NAMES, ids=lambda each: each)
def test_each_name_has_an_example(module, name):
    assert doctest.DocTestParser().get_examples(inspect.getdoc(find(module, name)) or "")


def public(module):
    """Return the public names of a module: those that it lists, else those that it defines."""
    own = inspect.getmembers(
        module, lambda each: getattr(each, "__module__", "") == module.__name__
    )
    return getattr(module, "__all__", [name for name, _ in own if not name.startswith("_")])


@pytest.mark.parametrize("module", [lnocl, simulation, psf, metrics, detection])
def test_each_public_name_is_in_the_reference(module):
    pages = {find(*each) for each in NAMES}
    assert [name for name in public(module) if getattr(module, name) not in pages] == []
