"""Timing the tunings of a device."""

import numpy as np
import pytest

from lnocl.core.opencl.device import choose, has_double
from lnocl.core.opencl.tuning import Tuning, candidates
from lnocl.studies import tuning
from lnocl.studies.tuning import Timed, fastest

FIRST, SECOND = Tuning(8, 8), Tuning(16, 16)


@pytest.mark.parametrize(("ratio", "taken"), [(0.5, SECOND), (0.98, FIRST), (1.4, FIRST)])
def test_the_safe_one_is_taken_unless_another_is_clearly_faster(ratio, taken):
    assert fastest([Timed(FIRST, 2.0, 1.0), Timed(SECOND, 2.0 * ratio, ratio)]) == taken


@pytest.mark.exhaustive
def test_every_candidate_is_timed_in_every_precision(monkeypatch):
    monkeypatch.setattr(tuning, "SIZE", 64)
    monkeypatch.setattr(tuning, "SECONDS_A_TURN", 0.01)
    device = choose().device
    found = dict(tuning.measure(None))
    assert set(found) == {np.dtype(t) for t in ("fd" if has_double(device) else "f")}
    for dtype, timed in found.items():
        assert [each.tuning for each in timed] == candidates(device, dtype)
        assert timed[0].ratio == 1.0
        assert all(0.0 < each.ms < 1e3 for each in timed)
