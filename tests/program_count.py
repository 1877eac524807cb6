"""Counts the OpenCL programs that the fast tests build: at most 45, all workers together.

A program takes seconds to compile. A test that needs another one should first look for a scene
whose program other tests build already, as `scenes` and `kernel_cases` have them.
"""

import pytest

from lnocl.opencl import program

MAX_PROGRAMS = 45
FAST = "not exhaustive and not system"

names = set()


class CountedProgram(program._Built):
    def __init__(self, context, text, options, file):
        super().__init__(context, text, options, file)
        names.add(file.name)


program._Built = CountedProgram


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    names.update(getattr(node, "workeroutput", {}).get("programs", ()))


def pytest_sessionfinish(session):
    for built in program._programs.values():
        built.store()  # workers end without what other processes do at their exit
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["programs"] = sorted(names)
    elif session.config.option.markexpr == FAST and len(names) > MAX_PROGRAMS:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config):
    count = f"{len(names)} OpenCL programs were built"
    if config.option.markexpr == FAST:
        count += f"; at most {MAX_PROGRAMS} are allowed"
    terminalreporter.write_line(count, red=len(names) > MAX_PROGRAMS)
