"""The lines of a result: numbers with errors, many stars, epochs, stars that no image shows."""

import re

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import lnocl
from lnocl.result.summary import MAX_LISTED, NUMBER, Unit, summary_lines, with_error

Y, X = np.indices((24, 40))
OPTIONS = {"engine": "numpy", "n_iter": 3, "stop": None, "smoothing": 0.0, "mend_images": False}


def spot(x, y):
    return np.exp(-((X - x) ** 2 + (Y - y) ** 2) / 3.0)


def lines_of(places, n_images=1, unit=None, **more):
    """Return the result of stars at some places, and its lines."""
    image = 30.0 + sum(900.0 * (1 + k) * spot(*place) for k, place in enumerate(places))
    psf = np.exp(-((np.indices((9, 9)) - 4) ** 2).sum(axis=0) / 3.0)
    scales = 1.0 + np.arange(n_images)[:, None, None]
    observation = lnocl.Observation(image * scales, psf, background=3.0, psf_error=0.0, **more)
    with pytest.warns(lnocl.LnoclWarning):
        result = lnocl.deconvolve(observation, places, **OPTIONS)
    return result, summary_lines(result, unit)


@given(st.floats(-1e12, 1e12), st.floats(1e-9, 1e9))
@example(0.0, 96.0)
@example(9999.96, 0.0999)
@example(-0.2, 31.0)
@example(9.99e6, 9.99e6)
def test_a_number_and_its_error_are_rounded_at_the_second_digit_of_the_error(value, error):
    shown, shown_error = (each.replace(" ", "") for each in with_error(value, error).split(" +- "))
    digit = 10.0 ** (int(f"{error:.1e}".partition("e")[2]) - 1)
    assert float(shown_error) == pytest.approx(error, abs=0.5001 * digit)
    assert float(shown) == pytest.approx(value, abs=0.5001 * digit + 1e-12 * abs(value))
    assert shown != "-0"
    if "e" not in shown:
        assert len(shown.partition(".")[2]) == len(shown_error.partition(".")[2])


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (142837.2, 314.0, "142 840 +- 310"),
        (142837.2, 96.4, "142 837 +- 96"),
        (0.5, 0.0312, "0.500 +- 0.031"),
        (2.5e-7, 3.1e-8, "2.50e-07 +- 3.1e-08"),
        (142837.2, np.nan, "142837"),
        (np.nan, 3.0, "unknown"),
    ],
)
def test_numbers_as_they_are_printed(value, error, expected):
    assert with_error(value, error) == expected


def test_units_and_columns():
    result, lines = lines_of([(9.0, 12.0), (30.0, 8.0)], unit=Unit("adu", 2.5))
    fluxes = zip(result.star_fluxes / 2.5, result.star_flux_errors / 2.5, strict=True)
    for k, (flux, error) in enumerate(fluxes):
        assert lines[k].endswith(f"{with_error(flux, error)} adu")
    found = [line.index(" +- ") for line in lines[:3]]
    assert len(set(found)) == 1
    assert lines[2].startswith("extended ")
    assert lines[3].startswith("trust ")
    assert lines[-1] == "3 iterations, all that were allowed"
    assert str(result).splitlines()[:2] == summary_lines(result)[:2]
    assert repr(result) == "<lnocl.Result of 2 stars and 40 x 24 pixels after 3 iterations>"


def test_of_many_stars_the_first_are_listed():
    places = [(4.0 + 4.0 * (k % 9), 6.0 + 10.0 * (k // 9)) for k in range(MAX_LISTED + 3)]
    _, lines = lines_of(places)
    assert [line.startswith("star ") for line in lines].count(True) == MAX_LISTED
    assert lines[MAX_LISTED] == "3 more stars      in its table"


def test_epochs_of_few_stars_are_a_table():
    mask = np.zeros((3, 24, 40), bool)
    mask[1, :, 24:] = True
    places = [(9.0, 12.0), (30.0, 8.0)]
    result, lines = lines_of(places, 3, epochs=["b", "a", "c"], mask=mask)
    assert lines[0].split("  ")[0] == "epoch"
    assert lines[0].endswith("  electrons, errors of epochs against the mean")
    fluxes = result.star_fluxes.reshape(2, 3)
    for epoch, label in enumerate("abc"):
        assert lines[1 + epoch].split()[0] == label
        changes = with_error(fluxes[0, epoch], result.star_variation_errors[epoch])
        assert changes in lines[1 + epoch]
    assert lines[1].endswith("unknown")  # epoch a, of the second image
    means, covariances = np.nanmean(fluxes, axis=1), result.star_flux_covariances
    errors = covariances[0].mean() ** 0.5, covariances[1, 1:, 1:].mean() ** 0.5
    found = [each.strip() for each in lines[4].split("  ") if each.strip()]
    assert found == ["mean", *map(with_error, means, errors)]
    assert len({len(line) for line in lines[1:5]}) == 1


def test_epochs_of_many_stars_are_ranges():
    places = [(4.0 + 7.0 * k, 8.0 + k) for k in range(5)]
    result, lines = lines_of(places, 2, epochs=[0, 1])
    error = np.median(result.star_flux_errors[:2])
    low, high = (with_error(each, error) for each in result.star_fluxes[:2])
    low = low.partition(" +- ")[0]
    assert re.fullmatch(
        rf"star 1 \(4, 8\) +{low} to {re.escape(high)} electrons in 2 epochs", lines[0]
    )


def test_a_star_that_no_pixel_shows_is_unknown():
    mask = X < 18
    _, lines = lines_of([(9.0, 12.0), (30.0, 8.0)], mask=mask)
    assert re.fullmatch(r"star 1 \(9, 12\) +unknown, as no good pixel shows it", lines[0])
    assert NUMBER.match(lines[1].partition(")")[2].strip())


def test_a_star_that_no_epoch_shows_is_unknown_in_all():
    mask = np.broadcast_to(X < 18, (3, 24, 40))
    _, lines = lines_of([(9.0, 12.0), (30.0, 8.0)], 3, epochs=[0, 1, 2], mask=mask)
    assert [line.split()[1] for line in lines[1:5]] == ["unknown"] * 4
