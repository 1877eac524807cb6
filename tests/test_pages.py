"""Pages that are read in order have commands that can be run in order, in one folder."""

import re
import shlex
from collections import Counter
from itertools import pairwise
from pathlib import Path

START = Path(__file__).parents[1] / "docs" / "start"


def test_no_command_of_getting_started_would_replace_the_output_of_another():
    names = re.findall(r"^\w+$", (START / "index.md").read_text(), re.MULTILINE)
    pages = "\n".join((START / f"{name}.md").read_text() for name in names)
    words = shlex.split("\n".join(re.findall(r"^```sh\n(.*?)^```", pages, re.M | re.S)))
    outputs = Counter(name for option, name in pairwise(words) if option in ("-o", "--plot"))
    assert outputs["jet.fits"] == 1
    assert max(outputs.values()) == 1, outputs
