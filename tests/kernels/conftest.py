"""The order of the tests of kernels."""

from pathlib import Path

import pytest
from kernel_cases import CASES

HERE = Path(__file__).parent


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Have a case's kernels of all files in a row, so that one process builds their program."""
    at = [
        k
        for k, item in enumerate(items)
        if item.path.is_relative_to(HERE)
        and "case" in getattr(getattr(item, "callspec", None), "params", {})
    ]
    order = list(CASES)

    def place(item):
        given = item.callspec.params
        return order.index(given["case"]), given["dtype"].__name__

    for k, item in zip(at, sorted((items[k] for k in at), key=place), strict=True):
        items[k] = item
