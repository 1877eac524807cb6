"""What a PSF shows at its edge: light beyond its file, and a level that does not fall."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, label
from scipy.special import log_ndtr

from lnocl.core.scene.arrays import Array, Mask

# Rings begin at this share of the way to the nearest edge: the light beyond is told from rings far
# out, its slope from rings that lie apart. So many rings at most, a pixel wide at least.
INNERMOST, RINGS, FEWEST = 0.4, 16, 4
# Logarithmic slopes at the edge, and how curved a profile is there: 0 for a power law, 1 for a
# Gaussian. Flatter profiles are as much more frequent. The light of exponents below 2 is infinite.
SLOPES = np.geomspace(1.0, 200.0, 120)
CURVATURES = np.append(0.0, np.geomspace(0.005, 0.9, 14))
LEAST_EXPONENT = 2.4
# Rings scatter about the best profile by this share of their light, at least.
SCATTER = 0.003
# Files hold most of the light of their PSFs: twice this share beyond is as much less likely as its
# square. Of 67 public PSFs half have 1.8 % or less beyond, and one in ten 4.8 % or more.
BEYOND = 0.1
# One PSF in two has a level, with this share of its light (one standard deviation).
LEVEL = 0.05
# Beyond the file a profile may go on in another way: one standard deviation of the light there.
ELSEWHERE = 0.1
# A wing of another form than those fitted is taken for a level of this share of the light beyond.
WING_AS_LEVEL = 0.03
# Profiles are tabulated in so many steps of the radius.
STEPS = 1000


class PsfEdge(NamedTuple):
    r"""Light beyond the file of a PSF, and a level within it, for a PSF of unit sum.

    The light beyond has the profile, R the radius of the largest circle within the file,

    .. math:: A \left(\frac{r^2 + a^2}{R^2 + a^2}\right)^{-n / 2}

    Attributes
    ----------
    light, light_error : float
        Light beyond the file, as a share of all within it, and its standard error.
    level, level_error : float
        Sum over the file of what all its pixels have alike, and its standard error: positive for a
        background that was not subtracted, negative for one of which too much was.
    amplitude : float
        A, the light in a pixel at R.
    exponent, core, radius : float
        n, without a unit; a and R, pixels of the PSF.
    known : ndarray of bool, shape (ky, kx)
        False where the PSF is 0 up to the edges of its array, which is beyond the file.
    """

    light: float
    light_error: float
    level: float
    level_error: float
    amplitude: float
    exponent: float
    core: float
    radius: float
    known: Mask

    @property
    def share(self) -> float:
        """The share of the light of the whole PSF, without the level, that is beyond the file."""
        return self.light / (1.0 - self.level + self.light)

    def wing(self, shape: tuple[int, int]) -> Array:
        """Return the light beyond the file in an array whose middle is that of the PSF.

        Parameters
        ----------
        shape : tuple of int
            (ny, nx), with the middle ``(ny // 2, nx // 2)``.

        Returns
        -------
        ndarray of float64, shape (ny, nx)
            0 within the file; its sum tends to `light` as the shape grows.
        """
        outside = ~_placed(self.known, shape)
        wing = np.zeros(shape)
        squares = _radii(shape)[outside] ** 2 + self.core**2
        edge = self.radius**2 + self.core**2
        wing[outside] = self.amplitude * (squares / edge) ** (-0.5 * self.exponent)
        return wing


def psf_edge(psf: Array) -> PsfEdge:
    r"""Return what the outer rings of a PSF tell of the light beyond its file, and of a level.

    The means of its rings from 0.4 R outwards are fitted by

    .. math:: A \left(\frac{r^2 + a^2}{R^2 + a^2}\right)^{-n / 2} + c, \qquad A > 0, n \ge 2.4

    for all n and a of a grid, with c and without. Errors are the noise of the pixels, from their
    second differences, and a scatter in proportion to the light, as large as the best fit needs.
    Light and level are means over the grid, weighted by likelihoods and priors. A halo as flat as a
    level, such as one of speckles that fill the file, is taken for one. Radii are in units
    of R, so that nothing depends on how finely a PSF is sampled.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx)
        Finite, of positive sum, its middle at ``(ky // 2, kx // 2)``. Where it is 0 up to the edges
        of the array, as beyond a circle, is beyond the file.

    Returns
    -------
    PsfEdge
        Zeros where the file has but one pixel, which has no rings.

    Examples
    --------
    A Moffat function of beta = 2 and FWHM = 3.5 has 0.59 % of its light beyond 64 x 64 pixels:

    >>> import numpy as np
    >>> from lnocl.core.scene.psf_edge import psf_edge
    >>> y, x = np.indices((64, 64)) - 32
    >>> edge = psf_edge((1 + (x**2 + y**2) / 2.72**2) ** -2.0)
    >>> print(f"{100 * edge.share:.2f} %, {100 * edge.level:.2f} %")
    0.58 %, 0.00 %
    """
    psf = psf / psf.sum()
    known, r = _known(psf), _radii(psf.shape)
    radius, furthest = _reach(known), float(r[known].max())
    if not furthest:
        return PsfEdge(0.0, 0.0, 0.0, 0.0, 0.0, LEAST_EXPONENT, 0.0, radius, known)
    chosen = known & (r >= INNERMOST * radius)
    forms = _Forms(radius, furthest)
    rings, level_prior = _Rings(psf, r, chosen, forms), LEVEL / int(known.sum())
    return _mean(forms, _settled(rings, level_prior), level_prior, known)


def _radii(shape: tuple[int, ...]) -> Array:
    """Return the distances of pixels from the middle of an array."""
    y, x = (np.arange(n) - n // 2 for n in shape)
    return np.hypot(y[:, None], x)


def _placed(known: Mask, shape: tuple[int, ...]) -> Mask:
    """Return a mask in an array of another shape, middle on middle."""
    placed = np.zeros(shape, bool)
    theirs, own = [], []
    for size, other in zip(known.shape, shape, strict=True):
        first = other // 2 - size // 2
        low, high = max(first, 0), min(first + size, other)
        theirs.append(slice(low, high))
        own.append(slice(low - first, high - first))
    placed[tuple(theirs)] = known[tuple(own)]
    return placed


def _known(psf: Array) -> Mask:
    """Return the pixels that are not of a region of zeros along the edges.

    Zeros among noise that was clipped are no region: it has squares of 5 x 5, its edges too.
    """
    zeros = binary_opening(np.pad(psf == 0.0, 5, constant_values=True), np.ones((5, 5)))
    labels, _ = label(zeros)
    known: Mask = (labels != labels[0, 0])[5:-5, 5:-5]
    return known


def _reach(known: Mask) -> float:
    """Return the radius of the largest circle round the middle that is known."""
    shape = tuple(n + 2 for n in known.shape)
    return float(_radii(shape)[~_placed(known, shape)].min()) - 0.5


class _Forms:
    """Profiles of all slopes and curvatures, 1 at the edge, tabulated over the radius.

    Attributes
    ----------
    exponent, core, slope : ndarray of float64, shape (n,)
        Of each form.
    table : ndarray of float64, shape (n, steps)
        The forms at radii ``step * k``, those within the rings as at their beginning.
    """

    def __init__(self, radius: float, furthest: float) -> None:
        slope, curvature = (each.ravel() for each in np.meshgrid(SLOPES, CURVATURES))
        exponent = slope / (1.0 - curvature)
        is_finite = exponent >= LEAST_EXPONENT
        self.radius, self.furthest, self.step = radius, furthest, furthest / STEPS
        self.slope, self.exponent = slope[is_finite], exponent[is_finite]
        self.core = radius * np.sqrt(curvature / (1.0 - curvature))[is_finite]
        at = self.step * np.maximum(np.arange(STEPS + 1), 0.95 * INNERMOST * radius / self.step)
        self.table = self._over_edge(at) ** (-0.5 * self.exponent[:, None])

    def _over_edge(self, r: Array | float) -> Array:
        squares = self.core[:, None] ** 2
        return np.asarray((np.square(r) + squares) / (self.radius**2 + squares))

    def steps(self, r: Array) -> NDArray[np.intp]:
        """Return where radii are in the table."""
        return np.rint(r / self.step).astype(np.intp)

    def light_outside(self, known: Mask) -> Array:
        """Return the light of each form in all pixels that are not known."""
        half = int(np.ceil(self.furthest))
        r = _radii((2 * half + 1, 2 * half + 1))
        missing = r[~_placed(known, r.shape) & (r <= self.furthest)]
        near = self.table @ np.bincount(self.steps(missing), minlength=STEPS + 1)
        ratio = self._over_edge(self.furthest)[:, 0]
        squares = self.furthest**2 + self.core**2
        far = 2.0 * np.pi / (self.exponent - 2.0) * squares * ratio ** (-0.5 * self.exponent)
        return np.asarray(near + far)


class _Rings:
    """Means of a PSF and of forms of its profile in rings, and their variances."""

    def __init__(self, psf: Array, r: Array, chosen: Mask, forms: _Forms) -> None:
        first = INNERMOST * forms.radius
        n = int(np.clip(forms.furthest - first, FEWEST, RINGS))
        edges = np.geomspace(first, forms.furthest, n + 1)[1:-1]
        number, size = np.digitize(r[chosen], edges), n * (STEPS + 1)
        places = number * (STEPS + 1) + forms.steps(r[chosen])
        counts = np.bincount(places, minlength=size).reshape(n, -1)
        pixels = counts.sum(axis=1)
        used = pixels > 0
        self.means = (np.bincount(number, psf[chosen], n)[used]) / pixels[used]
        self.forms = forms.table @ (counts[used] / pixels[used, None]).T
        # Where a profile rises and falls, as that of a pupil does, its envelope tells the scatter.
        envelope = np.maximum.accumulate(abs(self.means)[::-1])[::-1]
        self.variances = _noise(psf, chosen) ** 2 / pixels[used] + (SCATTER * envelope) ** 2
        self.variances += (np.finfo(float).eps * psf.max()) ** 2  # rounding


def _noise(psf: Array, chosen: Mask) -> float:
    """Return the standard deviation of pixels about what is smooth, from second differences."""
    squares, n = 0.0, 0
    for values, used in ((psf, chosen), (psf.T, chosen.T)):
        whole = used[:-2] & used[1:-1] & used[2:]
        squares += float(((values[:-2] - 2.0 * values[1:-1] + values[2:])[whole] ** 2).sum())
        n += int(whole.sum())
    return (squares / (6.0 * max(n, 1))) ** 0.5


class _Fits(NamedTuple):
    """Amplitudes and levels of each form, without a level and with one: arrays (2, n)."""

    chi_squared: Array
    amplitude: Array
    amplitude_variance: Array
    level: Array
    level_variance: Array


def _fits(rings: _Rings, level_prior: float) -> _Fits:
    """Return the best amplitudes and levels of all forms, from the normal equations."""
    w, m = 1.0 / rings.variances, rings.means
    aa, al, am = rings.forms**2 @ w, rings.forms @ w, rings.forms @ (w * m)
    ll, lm, mm = w.sum() + level_prior**-2, (w * m).sum(), (w * m * m).sum()
    determinant = aa * ll - al**2
    amplitude = np.stack([am / aa, (am * ll - lm * al) / determinant])
    level = np.stack([0.0 * aa, (lm * aa - am * al) / determinant])
    return _Fits(
        mm - amplitude * am - level * lm,
        amplitude,
        np.stack([1.0 / aa, ll / determinant]),
        level,
        np.stack([0.0 * aa, aa / determinant]),
    )


def _settled(rings: _Rings, level_prior: float) -> _Fits:
    """Return fits with variances as large as the best of them needs."""
    best = float(_fits(rings, level_prior).chi_squared.min())
    rings.variances *= max(1.0, best / max(len(rings.means) - FEWEST, 1))
    return _fits(rings, level_prior)


def _mean(forms: _Forms, fits: _Fits, level_prior: float, known: Mask) -> PsfEdge:
    """Return means over all forms, with a level and without."""
    occam = np.zeros_like(fits.level)
    occam[1] = -0.5 * np.log(fits.level_variance[1] / level_prior**2)
    amplitude, variance = _positive(fits.amplitude, fits.amplitude_variance)
    outside = forms.light_outside(known)
    rare = np.log1p((amplitude * outside / BEYOND) ** 2)
    logarithm = -0.5 * fits.chi_squared - occam - np.log(forms.slope) - rare
    weights = np.exp(logarithm - logarithm.max())
    weights /= weights.sum()
    light = float((weights * amplitude * outside).sum())
    scatter = weights * ((amplitude * outside - light) ** 2 + variance * outside**2)
    level = float((weights * fits.level).sum())
    spread = weights * ((fits.level - level) ** 2 + fits.level_variance)
    best, n = int(np.argmax(weights.sum(axis=0))), int(known.sum())
    return PsfEdge(
        light,
        float(np.hypot(np.sqrt(scatter.sum()), ELSEWHERE * light)),
        n * level,
        float(np.hypot(n * np.sqrt(spread.sum()), WING_AS_LEVEL * light)),
        light / float(outside[best]),
        float(forms.exponent[best]),
        float(forms.core[best]),
        forms.radius,
        known,
    )


def _positive(mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return means and variances of normal distributions of which nothing negative is left."""
    deviation = np.sqrt(variance)
    z = mean / deviation
    ratio = np.exp(-0.5 * z * z - 0.5 * np.log(2.0 * np.pi) - log_ndtr(z))
    return mean + deviation * ratio, variance * np.maximum(1.0 - z * ratio - ratio**2, 0.0)
