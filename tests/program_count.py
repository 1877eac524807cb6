"""Counts the OpenCL programs that the fast tests build, and names the test that builds each.

A program, a part of the kernels, takes up to two seconds to compile. A test that needs another one
should first look for a scene whose programs other tests build already, as `scenes` and
`kernel_cases` have them.
"""

import os
import weakref

import pytest

from lnocl.core.opencl import program

MAX_PROGRAMS = 32
FAST = "not exhaustive and not system"

built = {}  # the test that built each program first
held = weakref.WeakSet()


class CountedProgram(program._Built):
    def __init__(self, context, text, options, file):
        super().__init__(context, text, options, file)
        held.add(self)
        built.setdefault(file.name, os.environ.get("PYTEST_CURRENT_TEST", "a fixture"))


program._Built = CountedProgram
# The processors have test processes already.
program.ahead.begin = lambda *_: None


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    built.update(getattr(node, "workeroutput", {}).get("programs", {}))


def pytest_sessionfinish(session):
    for each in held:
        each.store()  # workers end without what other processes do at their exit
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["programs"] = built
    elif session.config.option.markexpr == FAST and len(built) > MAX_PROGRAMS:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config):
    count = f"{len(built)} OpenCL programs were built"
    if config.option.markexpr == FAST:
        count += f"; at most {MAX_PROGRAMS} are allowed"
    terminalreporter.write_line(count, red=len(built) > MAX_PROGRAMS)
    if config.option.verbose > 0 or len(built) > MAX_PROGRAMS:
        for test in sorted(built.values()):
            terminalreporter.write_line(f"  by {test}")
