"""The options of `deconvolve`: the values that each may have."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Real
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from lnocl.core.scene.arrays import Array, flag, numbers, whole
from lnocl.core.scene.components import refuse_unseen
from lnocl.core.scene.containers import counts
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_families import FAMILIES
from lnocl.core.solvers import SOLVERS
from lnocl.errors import InputError, note, warn

# The iteration of La Camera et al. (2012), whatever the defaults; mu and n_iter are given too.
PAPER: dict[str, Any] = {"solver": "sgm", "stop": None, "smoothing": 0.0, "pad": 0}

# Families of PSFs, and what an observation must have for them.
NEEDS = {"strehl": "ideal_psfs", "pupil": "pupils", "modes": "psf_modes"}

Precision = Literal["single", "double"]
EngineName = Literal["opencl", "numpy"]
StopName = Literal["held-out", "discrepancy"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
ENGINES: tuple[EngineName, ...] = get_args(EngineName)
STOPS: tuple[StopName, ...] = get_args(StopName)

# Kernels count iterations in single precision, whose whole numbers have 24 bits.
MAX_ITERATIONS = 2**24 - 2

# The difference between single and double precision, as a share of the extended source, for each
# iteration of a long run, and the share that is worth a warning (benchmarks/precision.py,
# docs/validation/precision.md).
ROUNDING_PER_ITERATION = 8e-9
ROUNDING_WORTH_A_WARNING = 1e-3


def check_observation(observation: object) -> None:
    """Refuse anything but an `Observation`, and one in which no good pixel shows a filter.

    Raises
    ------
    InputError
        `observation` is not an Observation; a filter is not seen.
    """
    if not isinstance(observation, Observation):
        raise InputError(
            f"observation is of type {type(observation).__name__}; give an lnocl.Observation, as "
            "lnocl.Observation(images, psfs) makes"
        )
    refuse_unseen(observation)


def check_choices(solver: str, precision: str, engine: str, device: object) -> None:
    """Refuse names that are not known, and a device for the reference.

    Raises
    ------
    InputError
        A name is unknown; a device is not text, or given for the reference.
    """
    choices = {
        "solver": (solver, SOLVERS),
        "precision": (precision, PRECISIONS),
        "engine": (engine, ENGINES),
    }
    for name, (value, known) in choices.items():
        if not (isinstance(value, str) and value in known):
            raise InputError(f"`{name}` {value!r} is not known; choose from {', '.join(known)}")
    if not (device is None or isinstance(device, str)):
        raise InputError(f"`device` must be text, PLATFORM[:DEVICE]; {device!r} was given")
    if engine == "numpy" and device is not None:
        raise InputError(f"`engine` numpy uses no device; leave `device` {device!r} out")


def read_refine_positions(value: object) -> bool | Literal["auto"]:
    """Return True, False or "auto".

    Raises
    ------
    InputError
        It is something else.
    """
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, str) and value == "auto":
        return "auto"
    raise InputError(f"`refine_positions` must be True, False or auto; {value!r} was given")


def check_families(
    names: object,
    observation: Observation,
    positions: Array,
    refine_positions: bool | str,
    is_auto: bool,
) -> tuple[str, ...]:
    """Return the families of PSFs that may be refined.

    `positions` are those of stars that show them. "auto" stands for those that any star shows; for
    none where PSFs are exact, or not all `is_auto`.

    Raises
    ------
    InputError
        A name is unknown, or one text is given instead of several; there is no star; ideal PSFs,
        pupils or modes are lacking; pupils differ in their apertures; a shift of one image is asked
        for beside free positions.
    """
    if isinstance(names, str) and names == "auto":
        names = automatic_families(observation) if is_auto and observation.psf_error else ()
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise InputError(
            f"`refine_psfs` is {names!r}; give auto, or a sequence of {', '.join(FAMILIES)}"
        )
    found = tuple(names)
    for name in found:
        if not (isinstance(name, str) and name in FAMILIES):
            raise InputError(f"`refine_psfs` {name!r} is not known; give {', '.join(FAMILIES)}")
    if found and not len(positions):
        raise InputError("`refine_psfs` needs a star, whose image shows the PSF; give stars")
    for name, needed in NEEDS.items():
        if name in found and not getattr(observation, needed).size:
            raise InputError(
                f"`refine_psfs` {name} needs `{needed}`; give them, or leave {name} out"
            )
    if "pupil" in found:
        from lnocl.core.scene.pupils import Pupil  # which loads scipy

        if len({Pupil(each).n_phases for each in observation.pupils}) > 1:
            raise InputError("pupils differ in their number of apertures; give as many in each")
    if "shift" in found and refine_positions is True and observation.n_images == 1:
        raise InputError(
            "`refine_psfs` shift of one image is told from nothing but the stars' places; leave it "
            "out, or `refine_positions`"
        )
    if not set(NEEDS) & set(found):
        # Those of pupils are ideal PSFs too.
        names = "psf_modes", "pupils" if observation.pupils.size else "ideal_psfs"
        for name in (name for name in names if getattr(observation, name).size):
            note(f"`{name}` have no part in this run, which does not refine the PSFs by them")
    return found


def automatic_families(observation: Observation) -> tuple[str, ...]:
    """Return the families that any star shows, where the observation has what they need."""
    shift = ("shift",) if observation.n_images > 1 else ()
    known = tuple(name for name, needed in NEEDS.items() if getattr(observation, needed).size)
    return (*shift, "jitter", *known, "pixels")


def check_length(n_iter: object, stop: object) -> None:
    """Refuse a number of iterations or a stopping rule out of range.

    Raises
    ------
    InputError
        `n_iter` is not a whole number from 1 to `MAX_ITERATIONS`; `stop` is not a known rule or a
        number between 0 and 1.
    """
    if whole("n_iter", n_iter, 1) > MAX_ITERATIONS:
        raise InputError(f"`n_iter` must be {MAX_ITERATIONS} at most; {n_iter} was given")
    is_change = isinstance(stop, Real) and 0 < cast(float, stop) < 1
    if not (stop is None or is_change or (isinstance(stop, str) and stop in STOPS)):
        raise InputError(
            f"`stop` {stop!r} is not known; give {', '.join(STOPS)}, none, or a number between 0 "
            "and 1"
        )


def check_types(callback: object, **flags: object) -> None:
    """Refuse a callback that cannot be called, and flags that are not True or False.

    Raises
    ------
    InputError
        One of them is of another type.
    """
    if not (callback is None or callable(callback)):
        raise InputError(f"callback must be a function or None; {callback!r} was given")
    for name, value in flags.items():
        flag(name, value)


def read_start(
    observation: Observation,
    fits_stars: bool,
    initial_extended: ArrayLike | None,
    initial_star_fluxes: ArrayLike | None,
) -> tuple[Array | None, Array | None]:
    """Return the start without its units, which are those of the result.

    Raises
    ------
    InputError
        Units that are not of counts, or of counts per time without exposures; an extended source
        of 0, and stars of 0 unless their fluxes are fitted at the start: iterations that multiply
        cannot leave it.
    """
    has_exposure = bool((observation.exposure != 1).any()) or None
    extended = fluxes = None
    if initial_extended is not None:
        given, _ = counts("initial_extended", initial_extended, has_exposure)
        extended = numbers("initial_extended", given)
    if initial_star_fluxes is not None:
        given, _ = counts("initial_star_fluxes", initial_star_fluxes, has_exposure, "counts")
        fluxes = numbers("initial_star_fluxes", given)
    if extended is not None and not extended.any():
        raise InputError(
            "`initial_extended` is 0 everywhere, which no iteration can leave; give it values "
            "above 0, or leave it out"
        )
    if fluxes is not None and not fits_stars and (n_dark := int((fluxes == 0).sum())):
        raise InputError(
            f"`initial_star_fluxes` holds {n_dark} of 0, which solver sgm multiplies and never "
            "leaves; give values above 0, leave those stars out, or take `solver` sgp"
        )
    return extended, fluxes


def read_smoothing(value: object) -> float | Literal["auto"]:
    """Return a number or "auto".

    Raises
    ------
    InputError
        It is another word.
    """
    if isinstance(value, str) and value != "auto":
        raise InputError(f"`smoothing` {value!r} is not known; give a number or auto")
    return cast(float | Literal["auto"], value)


def warn_of_rounding(n_iter: int) -> None:
    """Warn of more iterations than single precision is good for.

    Warns
    -----
    LnoclWarning
        The answer is expected to differ from that in double precision by a thousandth or more.
    """
    difference = ROUNDING_PER_ITERATION * n_iter
    if difference > ROUNDING_WORTH_A_WARNING:
        warn(
            f"single precision is expected to stray from double by {difference:.1g} of the "
            f"extended source after {n_iter} iterations; take `precision` double, or fewer "
            "iterations"
        )
