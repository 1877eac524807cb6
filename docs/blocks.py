"""Plugin of pytest that runs the code blocks of pages, as .ci/docs calls it.

Blocks of a page run one after the other in one empty folder; those of Python share a namespace.
A comment ``<!-- skip: next -->`` leaves the next block out.
"""

import os
import subprocess
from contextlib import ExitStack, chdir
from pathlib import Path
from tempfile import TemporaryDirectory

from sybil import Sybil
from sybil.parsers.myst import CodeBlockParser, PythonCodeBlockParser, SkipParser

os.environ.setdefault("MPLBACKEND", "Agg")


class ShellBlockParser(CodeBlockParser):
    """Finds blocks of shell, and runs them."""

    language = "sh"

    def evaluate(self, example):
        """Run a block; the first command that fails ends it."""
        subprocess.run(["bash", "-euo", "pipefail", "-c", example.parsed], check=True)


def enter_folder(namespace):
    """Go to an empty folder until the page ends."""
    namespace["_folder"] = stack = ExitStack()
    stack.enter_context(chdir(stack.enter_context(TemporaryDirectory())))


def leave_folder(namespace):
    """Remove the folder with all that the page has left."""
    namespace["_folder"].close()


pytest_collect_file = Sybil(
    parsers=[PythonCodeBlockParser(), ShellBlockParser(), SkipParser()],
    patterns=["*.md"],
    path=str(Path(__file__).parents[1]),
    setup=enter_folder,
    teardown=leave_folder,
).pytest()
