"""Plans: which steps they have, and that runs take these and no others."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl import reconstruction
from lnocl.core.runs import halos, mends, psf_refinement
from lnocl.core.runs.outcome import Mended
from lnocl.core.runs.plan import (
    CHOICE,
    CORES,
    EXPOSURES,
    HALOS,
    LEVELS,
    PLACES,
    PRIOR,
    PSFS,
    RAYS,
    STARS,
    STEPS,
)
from lnocl.core.runs.preparation import prepare
from lnocl.core.scene.penalty import recommend_smoothing
from lnocl.errors import InputError

Y, X = np.indices((24, 24))
PSF = np.exp(-((X[:17, :17] - 8.0) ** 2 + 1.3 * (Y[:17, :17] - 8.0) ** 2) / 3.0)
STAR = [(11.5, 11.5)]  # where turned images have it too
HALO = np.exp(-np.hypot(X - 10, Y - 13) / 9.0)
TURNED = lnocl.rotations([0.0, 20.0], (11.5, 11.5))
FIELD = lnocl.PsfField([PSF, PSF], [(0, 0), (23, 0)])


def observe(n=1, psfs=PSF, **known):
    mean = 20 + 4e4 * np.exp(-((X - 11.5) ** 2 + 1.3 * (Y - 11.5) ** 2) / 3.0)
    images = np.random.default_rng(5).poisson([mean] * n).astype(float)
    return lnocl.Observation(images, psfs, background=20.0, **known)


# The steps of a star in one image; then what is other in others, and what is said of it.
MENDED = {CORES, RAYS}
PLAIN = MENDED | {PSFS, PRIOR, CHOICE, STARS}
SCENES = {
    "plain": (observe, STAR, {}, PLAIN, "backgrounds have no error"),
    "no star": (observe, (), {}, {RAYS, CHOICE}, "there are no stars"),
    "a weight": (observe, STAR, {"smoothing": 0.1}, {CHOICE}, "`smoothing` is a number"),
    "a number of iterations": (
        observe,
        STAR,
        {"stop": None},
        {CORES, RAYS, PSFS, STARS},
        "another rule",
    ),
    "turned": (
        lambda: observe(2, transforms=TURNED),
        STAR,
        {},
        PLAIN | {PLACES, EXPOSURES},
        "no halos",
    ),
    "epochs": (lambda: observe(2, epochs=[0, 1]), STAR, {}, PLAIN, "no halos"),
    "a halo": (lambda: observe(halos=[HALO]), STAR, {}, PLAIN | {HALOS}, "have no error"),
    "a field": (lambda: observe(psfs=FIELD), STAR, {}, PLAIN, "no halos"),
    "levels": (lambda: observe(background_error=1.0), STAR, {}, PLAIN | {LEVELS}, "no halos"),
}


@pytest.mark.parametrize("name", SCENES)
def test_steps_of_a_scene_and_the_reasons_against_others(name):
    make, stars, options, expected, reason = SCENES[name]
    plan = lnocl.plan(make(), stars, **options)
    assert {step for step in STEPS if plan.does(step)} == expected
    others = [plan.why_not(step) for step in STEPS if step not in expected]
    assert any(reason in why for why in others)
    assert all(str(plan).count(f"{step}: no, ") == (step not in expected) for step in STEPS)


def test_a_step_of_another_name_is_refused():
    with pytest.raises(lnocl.InputError, match="no step is called 'judge'; choose from align"):
        lnocl.plan(observe()).does("judge")


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_a_run_takes_the_steps_of_its_plan(name, monkeypatch):
    """Each step has a function of its own, which is called or not."""
    make, stars, options, expected, _ = SCENES[name]
    called = set()

    def watch(step, module, function):
        real = getattr(module, function)

        def watched(*given, **more):
            called.add(step)
            return real(*given, **more)

        monkeypatch.setattr(module, function, watched)

    watch(CORES, mends, "mask_cores")
    watch(PLACES, mends, "align_images")
    watch(RAYS, mends, "mask_rays")
    watch(EXPOSURES, mends, "fit_exposures")
    watch(PSFS, psf_refinement, "mend")
    watch(LEVELS, halos, "settle_levels")
    watch(HALOS, halos, "settle_halos")
    watch(PRIOR, reconstruction, "told_prior")
    watch(CHOICE, reconstruction, "HeldOutCounts")
    result = lnocl.deconvolve(make(), stars, n_iter=99, engine="numpy", **options)
    called |= {STARS} if result._outcome.is_marginal else set()
    assert called == expected


def test_families_that_are_named_are_judged_whatever_the_smoothing():
    plan = lnocl.plan(observe(), STAR, smoothing=0.1, refine_psfs=["jitter"])
    assert plan.does("judge PSFs before the run")
    assert plan.families == ("jitter",)
    assert f"{PSFS}: yes, and fit jitter" in str(plan)
    assert plan.why_not(STARS) == "`smoothing` is a number"


def test_plan_names_steps_conditional_on_psfs_only_where_these_are_judged():
    judged, not_judged = lnocl.plan(observe(), STAR), lnocl.plan(observe(), STAR, smoothing=0.1)
    assert f"{CHOICE}: yes, unless PSFs are wrong" in str(judged)
    assert f"{CHOICE}: yes\n" in str(not_judged)


def test_levels_are_not_fitted_in_tiles():
    plan = replace(lnocl.plan(observe(background_error=1.0), STAR), in_tiles=True)
    assert plan.why_not(LEVELS) == "the images are divided into tiles"


def test_wrong_psfs_have_three_times_the_weight_and_no_held_out_counts(monkeypatch):
    wrong = np.ones((24, 24))
    monkeypatch.setattr(psf_refinement, "mend", lambda setup, *_: Mended(setup, None, wrong))
    prepared = prepare(lnocl.plan(observe(), STAR))
    (penalty,) = prepared.penalties
    assert penalty.smoothing == 3.0 * recommend_smoothing(observe())
    assert penalty.near_stars is wrong
    assert (prepared.stop, prepared.steady, prepared.is_within) == (1e-6, None, False)


def test_a_wrong_word_is_refused_before_any_work():
    with (
        patch.object(psf_refinement, "mend", side_effect=AssertionError),
        pytest.raises(InputError, match="smoothing 'none' is not known; give a number or auto"),
    ):
        lnocl.deconvolve(observe(), STAR, smoothing="none", engine="numpy")


def test_a_result_and_its_file_have_the_plan(tmp_path):
    given = observe(2, epochs=[0, 1])
    result = lnocl.deconvolve(given, STAR, n_iter=3, stop=None, engine="numpy")
    assert result.plan == str(lnocl.plan(given, STAR, n_iter=3, stop=None))
    result.write(str(tmp_path / "result.fits"))
    with fits.open(tmp_path / "result.fits") as hdus:
        rows = [": ".join(row) for row in hdus["PLAN"].data]
    assert rows == result.plan.splitlines()
