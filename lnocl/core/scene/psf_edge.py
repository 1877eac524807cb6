"""What a PSF shows at its edge: light beyond its file, and a level that does not fall."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, label
from scipy.special import log_ndtr

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.remembered import remembered
from lnocl.core.scene.transforms import enlarged

# Rings begin at this share of the way to the nearest edge: the light beyond is told from rings far
# out, its slope from rings that lie apart. So many rings at most, a pixel wide at least.
INNERMOST, RINGS, FEWEST = 0.4, 16, 4
# Smaller files, in pixels from the middle to the nearest edge, have too few rings to tell anything.
LEAST_RADIUS = 4.0
# Logarithmic slopes at the edge, and how curved a profile is there: 0 for a power law, 1 for a
# Gaussian. Flatter profiles are as much more frequent. The light of exponents below 2 is infinite.
SLOPES = np.geomspace(1.0, 200.0, 120)
CURVATURES = np.append(0.0, np.geomspace(0.005, 0.9, 14))
LEAST_EXPONENT = 2.4
# Rings scatter about the best profile by this share of their light, at least.
SCATTER = 0.003
# Files hold most of the light of their PSFs: twice this share beyond is as much less likely as its
# square. Of 67 public PSFs half have 1.7 % or less beyond, and one in ten 4.1 % or more.
BEYOND = 0.1
# One PSF in two has a second component, with this share of its light (one standard deviation): a
# level, or a halo with one of these slopes within the file and this exponent beyond it.
LEVEL = 0.05
HALO_SLOPES, HALO_EXPONENT = (0.5, 1.0, 1.5), 3.5
# Beyond the file a profile may go on in another way: one standard deviation of the light there, of
# a halo, which must change its slope, more.
ELSEWHERE, HALO_ELSEWHERE = 0.1, 0.5
# A wing of another form than those fitted is taken for a level of this share of the light beyond.
WING_AS_LEVEL = 0.03
# Profiles are tabulated in so many steps of the radius.
STEPS = 1000


class PsfEdge(NamedTuple):
    r"""Light beyond the file of a PSF, and a level within it, for a PSF of unit sum.

    The light beyond has the profile, R the radius of the largest circle within the file,

    .. math:: A \left(\frac{r^2 + a^2}{R^2 + a^2}\right)^{-n / 2} + H (r / R)^{-3.5}

    Attributes
    ----------
    light, light_error : float
        Light beyond the file, as a share of all within it, and its standard error.
    level, level_error : float
        Sum over the file of what all its pixels have alike, and its standard error: positive for a
        background that was not subtracted, negative for one of which too much was.
    amplitude, halo : float
        A and H, light in a pixel at R.
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
    halo: float
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
        outside = ~enlarged(self.known, shape, is_centred=True)
        wing = np.zeros(shape)
        r = _radii(shape)[outside]
        squares = (r**2 + self.core**2) / (self.radius**2 + self.core**2)
        wing[outside] = self.amplitude * squares ** (-0.5 * self.exponent)
        wing[outside] += self.halo * (r / self.radius) ** -HALO_EXPONENT
        return wing


@remembered(2**24)  # all fits of a run ask for the same few
def psf_edge(psf: Array) -> PsfEdge:
    r"""Return what the outer rings of a PSF tell of the light beyond its file, and of a level.

    The means of its rings from 0.4 R outwards are fitted by

    .. math:: A \left(\frac{r^2 + a^2}{R^2 + a^2}\right)^{-n / 2} + c (r / R)^{-t},
              \qquad A > 0, n \ge 2.4

    for all n and a of a grid, without c and with t of 0, 0.5, 1 and 1.5: a level has t = 0, and the
    others are halos, which are positive and go on beyond the file. Errors are the noise of the
    pixels, from their second differences, and a scatter in proportion to the light, as large as the
    best fit needs. Light and level are means over all, weighted by likelihoods and priors, so that
    a profile that may be either gives both large errors. Radii are in units of R, so that nothing
    depends on how finely a PSF is sampled.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx)
        Finite, of positive sum, its middle at ``(ky // 2, kx // 2)``. Where it is 0 up to the edges
        of the array, as beyond a circle, is beyond the file.

    Returns
    -------
    PsfEdge
        Zeros where an edge is less than 4 pixels from the middle, which tells nothing.

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
    if radius < LEAST_RADIUS:
        return PsfEdge(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, LEAST_EXPONENT, 0.0, radius, known)
    chosen = known & (r >= INNERMOST * radius)
    forms = _Forms(radius, furthest)
    return _mean(forms, _settled(_Rings(psf, r, chosen, forms), known, r), known)


def _radii(shape: tuple[int, ...]) -> Array:
    """Return the distances of pixels from the middle of an array."""
    y, x = (np.arange(n) - n // 2 for n in shape)
    return np.hypot(y[:, None], x)


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
    return float(_radii(shape)[~enlarged(known, (shape[0], shape[1]), is_centred=True)].min()) - 0.5


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

    def light_outside(self, known: Mask) -> tuple[Array, float]:
        """Return the light in all pixels that are not known, of each form and of a halo."""
        half = int(np.ceil(self.furthest))
        r = _radii((2 * half + 1, 2 * half + 1))
        missing = r[~enlarged(known, r.shape, is_centred=True) & (r <= self.furthest)]
        near = self.table @ np.bincount(self.steps(missing), minlength=STEPS + 1)
        ratio = self._over_edge(self.furthest)[:, 0]
        squares = self.furthest**2 + self.core**2
        far = 2.0 * np.pi / (self.exponent - 2.0) * squares * ratio ** (-0.5 * self.exponent)
        reach = self.furthest / self.radius
        halo = ((missing / self.radius) ** -HALO_EXPONENT).sum()
        halo += 2.0 * np.pi / (HALO_EXPONENT - 2.0) * self.radius**2 * reach ** (2 - HALO_EXPONENT)
        return np.asarray(near + far), float(halo)


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
        at = forms.step * np.maximum(np.arange(STEPS + 1), 1) / forms.radius
        shares = counts[used] / pixels[used, None]
        self.halos = [shares @ at**-slope for slope in (0.0, *HALO_SLOPES)]
        self.means = (np.bincount(number, psf[chosen], n)[used]) / pixels[used]
        self.forms = forms.table @ shares.T
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
    """Fits of each form, without a second component and with each: arrays (1 + components, n)."""

    cost: Array
    amplitude: Array
    amplitude_variance: Array
    second: Array
    second_variance: Array


def _fits(rings: _Rings, priors: Array) -> _Fits:
    """Return the best amplitudes of all forms, from the normal equations.

    The cost has half of chi squared, and the share of its prior that a component leaves open.
    """
    w, m = 1.0 / rings.variances, rings.means
    aa, am, mm = rings.forms**2 @ w, rings.forms @ (w * m), (w * m * m).sum()
    none, best = np.zeros_like(aa), am / aa
    rows = [(0.5 * (mm - best * am), best, 1.0 / aa, none, none)]
    for halo, prior in zip(rings.halos, priors, strict=True):
        al, ll, lm = rings.forms @ (w * halo), halo**2 @ w + prior**-2, halo @ (w * m)
        determinant = aa * ll - al**2
        first, second = (am * ll - lm * al) / determinant, (lm * aa - am * al) / determinant
        variance = aa / determinant
        cost = 0.5 * (mm - first * am - second * lm) + 0.5 * np.log(prior**2 / variance)
        cost += np.log(1.0 if not rows[1:] else len(priors) - 1.0)
        rows.append((cost, first, ll / determinant, second, variance))
    return _Fits(*(np.stack(each) for each in zip(*rows, strict=True)))


def _settled(rings: _Rings, known: Mask, r: Array) -> _Fits:
    """Return fits with variances as large as the best of them needs."""
    within = np.maximum(r[known], 1.0) / r[known].max()
    priors = LEVEL / np.array([(within**-slope).sum() for slope in (0, *HALO_SLOPES)])
    w, m = 1.0 / rings.variances, rings.means
    fits = _fits(rings, priors)
    left = m - fits.amplitude[..., None] * rings.forms
    seconds = np.stack([np.zeros_like(m), *rings.halos])
    left -= fits.second[..., None] * seconds[:, None]
    best = float((left**2 @ w).min())
    rings.variances *= max(1.0, best / max(len(m) - FEWEST, 1))
    return _fits(rings, priors)


def _mean(forms: _Forms, fits: _Fits, known: Mask) -> PsfEdge:
    """Return means over all fits."""
    first, variance = _positive(fits.amplitude, fits.amplitude_variance)
    second, second_variance = fits.second.copy(), fits.second_variance.copy()
    second[2:], second_variance[2:] = _positive(second[2:], second_variance[2:])
    outside, beyond = forms.light_outside(known)
    light, halo = first * outside, beyond * second
    halo[:2] = 0.0
    rare = np.log1p(((light + halo) / BEYOND) ** 2)
    logarithm = -fits.cost - np.log(forms.slope) - rare
    logarithm[2:] += log_ndtr(fits.second[2:] / np.sqrt(fits.second_variance[2:]))
    weights = np.exp(logarithm - logarithm.max())
    weights /= weights.sum()

    mean, halo_mean = float((weights * light).sum()), float((weights * halo).sum())
    spread = (light + halo - mean - halo_mean) ** 2 + variance * outside**2
    spread[2:] += second_variance[2:] * beyond**2 + (HALO_ELSEWHERE * halo[2:]) ** 2
    levels, n = second[1] * int(known.sum()), int(known.sum())
    level = float((weights[1] * levels).sum())
    level_spread = (weights[1] * ((levels - level) ** 2 + n**2 * second_variance[1])).sum()
    level_spread += (1.0 - weights[1].sum()) * level**2
    best = int(np.argmax(weights.sum(axis=0)))
    return PsfEdge(
        mean + halo_mean,
        float(np.hypot(np.sqrt((weights * spread).sum()), ELSEWHERE * mean)),
        level,
        float(np.hypot(np.sqrt(level_spread), WING_AS_LEVEL * (mean + halo_mean))),
        mean / float(outside[best]),
        halo_mean / beyond,
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
