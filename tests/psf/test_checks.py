"""Arguments that cannot be used are refused in one line, and any others give a PSF."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from star_frames import STAR, gaussian, quiet

from lnocl.errors import InputError, LnoclError

BROAD = 40 + 90000 * gaussian(12.0, 30, 30, (61, 70))


UNREPAIRABLE = np.where(np.hypot(*(np.mgrid[:61, :70] - 30)) < 6, np.nan, BROAD)


REFUSED = {
    "frame holds <U1; give real numbers": {"frame": [["a"]]},
    "frame cannot be read as an array: its rows differ": {"frame": [[1], [1, 2]]},
    "frame has shape (3,); give one image, (ny, nx)": {"frame": [1, 2, 3]},
    "frame has shape (0, 5); give one image, (ny, nx)": {"frame": np.zeros((0, 5))},
    "frame holds values beyond 1e+150; give it in another unit": {"frame": 1e151 * STAR},
    "all pixels of the frame are bad; give a frame that shows a star": {"frame": np.nan * STAR},
    "mask is of type int64; give booleans, True where a pixel is bad": {
        "mask": np.zeros(STAR.shape, np.int64)
    },
    "mask has shape (2, 2); the frame has (61, 70)": {"mask": np.zeros((2, 2), bool)},
    "mask has 3 masked values; fill them or leave them out": {
        "mask": np.ma.array(STAR > 1e9, mask=np.eye(*STAR.shape) * np.arange(70) > 57)
    },
    "mask cannot be read as an array: its rows differ": {"mask": [[True], [True, False]]},
    "position has 1 masked value; fill it or leave it out": {
        "position": np.ma.array([30, 29], mask=[0, 1])
    },
    "background has 1 masked value": {"background": np.ma.masked},
    "position is (1,); give two finite numbers, x and y": {"position": (1,)},
    "position is (1, nan); give two finite numbers, x and y": {"position": (1, math.nan)},
    "position (70, 3) is outside the frame of 70 x 61 pixels; give x and y, 0-based": {
        "position": (70, 3)
    },
    "size must be a whole number, 3 or more; 2 was given": {"size": 2},
    "size must be a whole number, 3 or more; 8.0 was given": {"size": 8.0},
    "size must be a whole number, 3 or more; True was given": {"size": True},
    "a PSF of 300 x 300 pixels around the star at x = 30, y = 29 reaches beyond the frame; "
    "give a size of 59 or less": {"size": 300},
    "the star at x = 0, y = 29 is at the edge of the frame; give another": {
        "position": (0, 29), "recentre": False,
    },
    'background is \'sky\'; give a number or "auto"': {"background": "sky"},
    "background is nan; give one finite number": {"background": math.nan},
    "background is [1, 2]; give one finite number": {"background": [1, 2]},
    "no good pixel is left for the background; give it as a number": {
        "frame": np.pad(STAR[20:41, 20:41], 3, constant_values=np.nan)
    },
    "nothing within 16 pixels of the star is above the background 1e+06; give another position "
    "or a lower background": {"background": 1e6},
    "the flux of the PSF above the background 400 is": {"background": 400.0, "recentre": False},
    "no star is found within 16 pixels of (47, 29); give its position, or another background": {
        "background": 40.0, "position": (47, 29),
    },
    "saturation must be positive; -1 was given": {"saturation": -1},
    "saturation must be positive; 0 was given": {"saturation": 0},
    "rotate is inf; give one finite number": {"rotate": math.inf},
    "recentre must be True or False; 'no' was given": {"recentre": "no"},
    "clip_negative must be True or False; 1 was given": {"clip_negative": 1},
    "the star at x = 30, y = 30 has too few good pixels among the 11 x 11 around it; take a frame "
    "with a shorter exposure": {"frame": UNREPAIRABLE},
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_invalid_arguments_are_refused_in_one_line(message):
    with pytest.raises(InputError) as refusal:
        quiet(**({"frame": STAR} | REFUSED[message]))
    assert str(refusal.value).startswith(message)
    assert "\n" not in str(refusal.value)


ANYTHING = st.one_of(
    st.none(), st.booleans(), st.integers(-5, 50), st.floats(), st.text(max_size=3),
    st.lists(st.floats(-100, 100), max_size=3),
)  # fmt: skip


FRAMES = st.one_of(
    ANYTHING,
    st.builds(
        lambda ny, nx, seed, bad, amplitude: np.where(
            np.random.default_rng(seed).random((ny, nx)) < bad,
            np.nan,
            amplitude * gaussian(3.0, nx // 2, ny // 2, (ny, nx))
            + np.random.default_rng(seed + 1).normal(0, 1, (ny, nx)),
        ),
        st.integers(1, 24), st.integers(1, 24), st.integers(0, 99),
        st.sampled_from([0.0, 0.1, 0.6]), st.sampled_from([0.0, 30.0, 1e4, 1e140]),
    ),
)  # fmt: skip


@pytest.mark.exhaustive
@given(
    frame=FRAMES,
    options=st.fixed_dictionaries(
        {},
        optional={
            name: ANYTHING
            for name in (
                "position", "size", "background", "mask", "saturation", "recentre",
                "clip_negative", "rotate",
            )
        },
    ),
)  # fmt: skip
def test_any_input_gives_a_psf_or_one_line(frame, options):
    try:
        star = quiet(frame, **options)
    except LnoclError:
        return
    assert np.isfinite(star.psf).all()
    assert star.psf.sum() == pytest.approx(1.0, abs=1e-9 * np.abs(star.psf).sum())
    assert len(set(star.psf.shape)) == 1
