"""What goes together: kinds of scenes, down, and what is done with each, across."""

import warnings
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from kinds import (
    BRIGHTER,
    FLUXES,
    HOST,
    HOST_FLUX,
    KNOT,
    NARROW,
    STARS,
    TRUE,
    N,
    X,
    Y,
    observe,
)

import lnocl
from lnocl.io.saved_results import read_result

# Kinds of scenes, and pairs of kinds that meet in one formula or more.
KINDS = [
    *("plain", "masked", "exposures", "exposure map", "padded", "offsets", "several shapes"),
    *("turned", "scaled", "finer sky", "epochs", "halos", "PSF field", "transmission"),
    *("star PSFs", "level", "components"),
    *("turned + epochs", "turned + halos", "turned + transmission", "turned + star PSFs"),
    *("turned + finer sky", "turned + PSF field"),
    *("scaled + epochs", "several shapes + halos", "epochs + halos", "epochs + PSF field"),
    *("transmission + epochs", "finer sky + halos", "PSF field + halos", "star PSFs + epochs"),
    *("turned + components", "finer sky + components", "epochs + components"),
    *("halos + components", "transmission + components", "PSF field + components"),
]
BRIGHT, FAINT = map(tuple, STARS.tolist())
ROOT = Path(__file__).parents[2]
SHORT = {"n_iter": 12, "stop": None, "smoothing": 0.3}
# No counts are held out: a kind has a test of that.
FIXED = {"n_iter": 60, "stop": None, "smoothing": 1.0}


@cache
def run(kind, stars=(BRIGHT, FAINT), xx=TRUE, engine="numpy", psf_error=0.0, **options):
    pad = 16 if "padded" in kind else "auto"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)  # of stars masked at their peaks
        observation = observe(kind, xx)[0].replace(psf_error=psf_error)
        return lnocl.deconvolve(observation, stars, pad=pad, engine=engine, **options)


@cache
def replicas(kind, parallel=False):
    return run(kind).bootstrap(10, seed=3, parallel=parallel)


def mends_psfs(kind):
    """PSFs of a core that is 8 % too narrow, which make the stars up to 7 % too faint."""
    result = run(kind, xx=NARROW, n_iter=30, stop=None, refine_psfs=("jitter",))
    _, fluxes = observe(kind)
    found = result.psf_refinement
    assert found.is_accepted
    wider = found.values[:, found.parameters.index("jitter xx")]
    np.testing.assert_allclose(wider, TRUE - NARROW, rtol=0.2)
    np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=0.03)
    assert (abs(result.star_fluxes - fluxes) < 3 * result.star_flux_errors).all()


def doubts_psfs(kind):
    """PSFs may have an error: they have a core that is 8 % too narrow.

    That is 2.7 standard deviations of the prior; fluxes are 3.2 of their errors off at most.
    """
    _, fluxes = observe(kind)
    result = run(kind, xx=NARROW, psf_error=0.03, **FIXED)
    assert (abs(result.star_fluxes - fluxes) < 3.3 * result.star_flux_errors).all()
    assert np.isfinite(result.extended).all()
    assert (result.star_flux_errors > run(kind).star_flux_errors).all()


def moves_stars(kind):
    """The faint star, which was given elsewhere, is moved to its place."""
    given = BRIGHT, (FAINT[0] - 0.4, FAINT[1] + 0.5)
    result = run(kind, given, refine_positions=True, smoothing=1.0, stop=1e-4)
    away = result.star_positions[-1] - FAINT
    assert np.hypot(*away) < 0.05
    assert (abs(away) < 4 * result.star_position_errors[-1]).all()


def gives_marginal_fluxes(kind):
    result, (_, fluxes) = run(kind), observe(kind)
    assert result.psf_refinement is None
    np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=0.02)
    assert (abs(result.star_fluxes - fluxes) < 3 * result.star_flux_errors).all()


def holds_counts_out(kind):
    """They end the run where the host has its light."""
    result, q = run(kind), observe(kind)[0].oversample
    assert result.stop_reason == "held-out"
    places = [KNOT, HOST] if result.component_names else [HOST]
    for sky, (x, y) in zip(result.extended.reshape(-1, N, q, N, q), places, strict=True):
        light, is_near = sky.sum(axis=(1, 3)), np.hypot(X - x, Y - y) < 8
        np.testing.assert_allclose(light[is_near].sum(), HOST_FLUX, rtol=0.1)


def makes_replicas(kind):
    found, (_, fluxes) = replicas(kind), observe(kind)
    stars = [k for k, each in enumerate(found.quantities) if each.name.startswith("star")]
    assert len(stars) == len(fluxes)
    assert (abs(found.values[stars] - fluxes) < 4 * found.standard_errors[stars]).all()


def works_in_parallel(kind):
    """Another process gives the same replicas."""
    found = replicas(kind, "current-scheduler")
    for name in ("values", "standard_errors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(replicas(kind), name))


def detects(kind):
    """The faint star, where the bright one alone is known; and limits."""
    mixing = observe(kind)[0].mixing
    names = [None] if mixing is None else mixing.filter_names
    found = run(kind, (BRIGHT,)).significance(false_alarms=0.01, images_of=names[0])
    varies = "epochs" in kind and names == [None]
    table, flux = found.detections, FLUXES[1] * ((1 + BRIGHTER) / 2 if varies else 1)
    distances = np.hypot(table["x"].value - FAINT[0], table["y"].value - FAINT[1])
    nearest = table[int(distances.argmin())]
    assert distances.min() < 0.1
    assert nearest["kind"] == "point"
    np.testing.assert_allclose(nearest["flux"].value, flux, rtol=0.03)
    assert abs(nearest["flux"].value - flux) < 4 * nearest["flux_error"].value
    limit = found.limit(0.5)
    assert np.isfinite(limit).mean() > 0.6
    assert np.nanmin(limit) > 0


def goes_on(kind):
    """From a checkpoint, bit for bit."""
    whole = run(kind, engine="opencl", **SHORT)
    with TemporaryDirectory() as folder:
        path = f"{folder}/run.fits"
        run(kind, engine="opencl", **SHORT, checkpoint=path, callback=lambda k, _: k == 5)
        found = run(kind, engine="opencl", **SHORT, resume=path)
    for name in ("extended", "star_fluxes", "history"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


def agrees_with_the_reference(kind):
    expected = run(kind, **SHORT)
    for precision, allowed in (("double", 1e-9), ("single", 2e-3)):
        found = run(kind, engine="opencl", **SHORT, precision=precision)
        for name in ("extended", "star_fluxes"):
            values = getattr(expected, name)
            difference = abs(getattr(found, name) - values).max()
            assert difference < allowed * abs(values).max(), (precision, name, difference)


def is_written_and_read(kind):
    result = run(kind)
    with TemporaryDirectory() as folder:
        path = f"{folder}/result.fits"
        result.write(path)
        again = read_result(path)
        np.testing.assert_array_equal(again.extended, result.extended)
        np.testing.assert_array_equal(np.ravel(again.star_fluxes), result.star_fluxes)


DONE = {
    "PSFs mended": mends_psfs,
    "PSFs doubted": doubts_psfs,
    "positions": moves_stars,
    "marginal fluxes": gives_marginal_fluxes,
    "held-out counts": holds_counts_out,
    "replicas": makes_replicas,
    "parallel": works_in_parallel,
    "detections and limits": detects,
    "checkpoint": goes_on,
    "double and single": agrees_with_the_reference,
    "written and read": is_written_and_read,
}


def test_documentation_table_lists_every_kind_of_scene():
    lines = (ROOT / "docs/guide/together.md").read_text().splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    header, _, *rows = rows[: len(KINDS) + 2]
    assert header == ["scene", *DONE]
    assert rows == [[kind, *["yes"] * len(DONE)] for kind in KINDS]


@pytest.fixture(scope="module")
def worker():
    from distributed import Client, LocalCluster

    one = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**one) as cluster, Client(cluster):
        yield


# One of several kinds and of much that is done.
FAST = {("star PSFs + epochs", "PSFs mended")}
CELLS = [
    pytest.param(*cell, marks=[] if cell in FAST else pytest.mark.exhaustive)
    for cell in product(KINDS, DONE)
]


@pytest.mark.parametrize(("kind", "what"), CELLS)
def test_every_kind_of_scene_goes_with_everything_that_is_done(kind, what, request):
    if what == "parallel":
        request.getfixturevalue("worker")
    DONE[what](kind)
