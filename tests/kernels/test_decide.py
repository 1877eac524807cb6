"""What a solver decides against its twin."""

import re
from dataclasses import fields

from kernel_cases import FOLDER, agree_with_twins

from lnocl.core.reference import decide
from lnocl.core.scene import band_matrix, steps

test_kernels_agree_with_their_twins = agree_with_twins("decide.cl")


def test_the_numbers_of_a_run_have_one_order_in_kernels_and_twins():
    source = (FOLDER / "precision.cl").read_text(encoding="ascii")
    (names,) = re.findall(r"enum \{([^}]*)\}", source)
    listed = re.findall(r"^ +(\w+),", names, re.MULTILINE)
    assert [name.lower() for name in listed] == [field.name for field in fields(steps.Steps)]


def test_reasons_and_constants_are_those_of_the_kernels():
    source = (FOLDER / "decide.cl").read_text(encoding="ascii")
    (names,) = re.findall(r"enum \{([^}]*)\}", source)
    reasons = [name.strip() for name in names.split(",")]
    assert [getattr(steps, reason) for reason in reasons] == list(range(len(reasons)))
    defined = dict(re.findall(r"#define (\w+) \(?(?:\(real\))?([\d.e-]+)\)?\n", source))
    shortest, longest = decide.ALPHA_BOUNDS
    own = {"SHORTEST": shortest, "LONGEST": longest}
    assert {name: float(value) for name, value in defined.items()} == {
        name: own.get(name) or (vars(band_matrix) | vars(decide))[name] for name in defined
    }
    assert len(defined) == 10
