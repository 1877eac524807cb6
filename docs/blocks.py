"""Plugin of pytest that runs the code blocks of pages, as .ci/docs calls it.

Blocks of a page run one after the other in one empty folder; those of Python share a namespace.
A block ``output`` holds what the block before it prints; ``...`` stands for whatever is left out,
and numbers may differ by `TOLERANCE`, as those of another machine do.
A comment ``<!-- skip: next -->`` leaves the next block out.
"""

import math
import os
import re
import subprocess
from contextlib import ExitStack, chdir, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

from sybil import Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.myst import CodeBlockParser, SkipParser

os.environ.setdefault("MPLBACKEND", "Agg")


def run_python(example):
    """Run a block of Python."""
    with redirect_stdout(StringIO()) as printed:
        PythonEvaluator()(example)
    example.namespace["_printed"] = printed.getvalue()


def run_shell(example):
    """Run a block of shell; the first command that fails ends it."""
    command = ["bash", "-euo", "pipefail", "-c", example.parsed]
    ended = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    example.namespace["_printed"] = ended.stdout
    return f"it failed:\n{ended.stdout}" if ended.returncode else None


def compare_output(example):
    """Compare what a page shows with what was printed, but for white space."""
    printed = PROGRESS.sub("", example.namespace["_printed"])
    return None if is_shown(example.parsed, printed) else f"the block before it prints:\n{printed}"


def is_shown(shown, printed):
    """Return whether an output block shows what was printed."""
    shown, printed = (" ".join(text.split()) for text in (shown, printed))
    parts = re.split(rf"({NUMBER}|\.\.\.)", shown)
    pattern = "".join(
        (".*?" if part == "..." else rf"({NUMBER})") if k % 2 else re.escape(part)
        for k, part in enumerate(parts)
    )
    found = re.fullmatch(pattern, printed, re.DOTALL)
    numbers = (float(part.replace(" ", "")) for part in parts[1::2] if part != "...")
    return bool(found) and all(
        math.isclose(number, float(other.replace(" ", "")), rel_tol=TOLERANCE)
        for number, other in zip(numbers, found.groups(), strict=True)
    )


def enter_folder(namespace):
    """Go to an empty folder until the page ends."""
    namespace["_folder"] = stack = ExitStack()
    stack.enter_context(chdir(stack.enter_context(TemporaryDirectory())))


def leave_folder(namespace):
    """Remove the folder with all that the page has left."""
    namespace["_folder"].close()


# Results of held-out counts may end an iteration earlier elsewhere.
TOLERANCE = 0.05
NUMBER = r"[-+]?\d+(?: \d{3}\b)*(?:\.\d+)?(?:e[-+]?\d+)?"
# Lines on progress, which slow machines have more of.
PROGRESS = re.compile(r"^lnocl: [^:]*: ([^:]*, )?\d+ (s|min)\n", re.MULTILINE)
RUN = {"python": run_python, "sh": run_shell, "output": compare_output}

pytest_collect_file = Sybil(
    parsers=[*(CodeBlockParser(name, run) for name, run in RUN.items()), SkipParser()],
    patterns=["*.md"],
    path=str(Path(__file__).parents[1]),
    setup=enter_folder,
    teardown=leave_folder,
).pytest()
