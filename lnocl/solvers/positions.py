"""Star positions and fluxes from the likelihood's own gradient, the extended source held fixed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lnocl.scene.forward_model import Model
from lnocl.scene.observation import Array
from lnocl.scene.scene import LEAST_MODEL, Scene
from lnocl.scene.shifting import MARGIN, place

# How far from where it was given a star may go, in pixels.
RADIUS = 3.0
# And in one step: the likelihood is a parabola in a part of the PSF's core only.
LONGEST_STEP = 0.5
# No flux falls to less than this share in one step.
MOST_FADING = 0.1
# Share of what the data say of a position that the pixels which are looked at must hold: far wings
# say little and are many.
INFORMATION_SHARE = 0.99
# Of a PSF's peak: what its darkest pixels are taken for there, which may be 0 or less.
LEAST_LIT = 1e-6
# Steps end where they are less than this share of a standard error that images of unit mean would
# give: of a tenth of their own up to a mean of a million electrons.
FINISHED = 1e-4
MOST_STEPS = 30
# Before the first, each star is tried this far along x and y too: fringes make false minima.
TRIED = 1.5
MOST_HALVED = 10


class Stars(NamedTuple):
    """Fluxes, shape (n,), and positions, shape (n, 2), of stars."""

    fluxes: Array
    positions: Array


class StarFit:
    """The likelihood of stars, for an extended source that is known.

    ``J_0(c, x, y)`` with ``m_j = A_j f + sum_s c_s P_j(x_s, y_s) + b_j`` is minimised by Fisher
    scoring over all of them together, ``F = sum_j <D_j, w_j D_j / m_j>``, D the derivatives of the
    m_j: ``P_js``, and ``c_s`` times its derivatives with respect to x_s and y_s. Looked at are
    squares round the stars that hold 99 % of the information on positions; the light of PSFs beyond
    them stays where the stars of the scene put it.

    Parameters
    ----------
    scene : Scene
        What is modelled; its stars are where the search begins.
    model : Model
        Of the scene.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source, on the grid and scaled.
    given : ndarray of float64, shape (n, 2)
        Positions that the stars must stay within `RADIUS` of.
    """

    def __init__(self, scene: Scene, model: Model, extended: Array, given: Array) -> None:
        self._scene, self._given = scene, given
        self._psfs = _cut(scene.scaled_psfs())
        lit = self._lit_pixels()
        self._place = np.cumsum(lit) - 1
        self._n_lit = int(lit.sum())
        self._images = scene.images().ravel()[lit]
        self._diffuse = (model.forward(extended) + model.background).ravel()[lit]
        self._weights = model.weights.ravel()[lit]
        units = np.eye(scene.n_stars)
        whole = [np.array([*model.starlight(unit)]).ravel()[lit] for unit in units]
        self._beyond = np.array(whole).T - self._columns(0, scene.stars).toarray()

    def _lit_pixels(self) -> NDArray[np.bool_]:
        """Return which pixels of the images a star may light, wherever it goes."""
        grid, reach = self._scene.grid, int(np.ceil(RADIUS)) + MARGIN + 1
        lit = np.zeros((self._scene.n_images, *grid), bool)
        for j, psf in enumerate(self._psfs):
            for position in self._given:
                x, y = np.floor(position + self._scene.observation.offsets[j] + 0.5)
                stamp = place(np.pad(psf, reach), grid, x, y)
                lit[j][np.ix_(stamp.rows(grid), stamp.columns(grid))] = True
        return lit.ravel()

    def _columns(self, k: int, positions: Array) -> Any:
        """Return as sparse columns the ``P_js`` of all stars, or derivatives of them."""
        lit = [self._light(k, position) for position in positions]
        ends = np.cumsum([0] + [len(values) for _, values in lit])
        pixels, values = (np.concatenate([each[i] for each in lit]) for i in range(2))
        return sparse.csc_array((values, pixels, ends), (self._n_lit, len(lit)))

    def _light(self, k: int, position: Array) -> tuple[NDArray[np.int64], Array]:
        ny, nx = self._scene.grid
        pixels, values = [], []
        for j, psf in enumerate(self._psfs):
            x, y = position + self._scene.observation.offsets[j]
            stamp = place(psf, (ny, nx), x, y, (None, 1, 0)[k])
            rows, columns = stamp.rows((ny, nx)), stamp.columns((ny, nx))
            pixels.append(((j * ny + rows)[:, None] * nx + columns).ravel())
            values.append(stamp.values.ravel())
        return self._place[np.concatenate(pixels)], np.concatenate(values)

    def _light_of(self, positions: Array) -> Any:
        """Return the ``P_js`` of all stars as sparse columns, what lies beyond the squares too."""
        return self._columns(0, positions) + sparse.csc_array(self._beyond)

    def _data_term(self, model: Array) -> float:
        model = np.maximum(model, LEAST_MODEL)
        return float(self._weights @ (model - self._images * np.log(model)))

    def objective(self, stars: Stars) -> float:
        """Return J_0 over the pixels that stars may light, but for a constant."""
        return self._data_term(self._diffuse + self._light_of(stars.positions) @ stars.fluxes)

    def derivatives(self, stars: Stars) -> tuple[Array, Array]:
        """Return gradient and Fisher information of J_0 in (c_1 ... c_n, x_1 ..., y_1 ...)."""
        light = self._light_of(stars.positions)
        moved = [self._columns(k, stars.positions) for k in (1, 2)]
        model = np.maximum(self._diffuse + light @ stars.fluxes, LEAST_MODEL)
        columns = sparse.hstack([light, *(each * stars.fluxes for each in moved)], format="csc")
        weights = np.where(model > LEAST_MODEL, self._weights, 0.0)  # the guard does not move
        gradient = columns.T @ (weights * (1.0 - self._images / model))
        weighted = columns * (weights / model)[:, None]
        return gradient, (columns.T @ weighted).toarray()

    def look_round(self, stars: Stars) -> Stars:
        """Return each star at the best of nine places, the others where they are, and its flux."""
        light = self._light_of(stars.positions)
        fluxes, positions = stars.fluxes.copy(), stars.positions.copy()
        steps = TRIED * np.array([(dx, dy) for dx in (0, -1, 1) for dy in (0, -1, 1)])
        for s, position in enumerate(stars.positions):
            others = self._diffuse + light @ np.where(np.arange(len(fluxes)) == s, 0.0, fluxes)
            least = MOST_FADING * fluxes[s]
            tried = [self._try(s, position + step, others, least) for step in steps]
            best = int(np.argmin([objective for objective, _ in tried]))
            positions[s], fluxes[s] = position + steps[best], tried[best][1]
        return Stars(fluxes, positions)

    def _try(self, s: int, position: Array, others: Array, least: float) -> tuple[float, float]:
        """Return J_0 with star s there, and its flux by weighted least squares, or the least."""
        star = self._columns(0, position[None]).toarray()[:, 0] + self._beyond[:, s]
        weighted = self._weights * star / np.maximum(np.maximum(self._images, others), LEAST_MODEL)
        norm = float(weighted @ star)
        flux = max(float(weighted @ (self._images - others)) / norm if norm > 0 else 0.0, least)
        return self._data_term(others + flux * star), flux

    def minimise(self, stars: Stars) -> Stars:
        """Return the stars that are most likely, sought from these."""
        objective = self.objective(stars)
        for _ in range(MOST_STEPS):
            gradient, information = self.derivatives(stars)
            step = -_invert(information) @ gradient
            for _ in range(MOST_HALVED):
                following = self._follow(stars, step)
                lower = self.objective(following)
                if lower <= objective:
                    break
                step = step / 2.0
            else:
                return stars
            moves = following.positions - stars.positions
            change = np.concatenate([following.fluxes - stars.fluxes, *moves.T])
            stars, objective = following, lower
            if (abs(change) * np.sqrt(np.diag(information)) < FINISHED).all():
                break
        return stars

    def _follow(self, stars: Stars, step: Array) -> Stars:
        """Return stars a step farther, within what is allowed."""
        n = len(stars.fluxes)
        fluxes = np.maximum(stars.fluxes + step[:n], MOST_FADING * stars.fluxes)
        moves = _shorten(step[n:].reshape(2, n).T, LONGEST_STEP)
        return Stars(fluxes, self._given + _shorten(stars.positions + moves - self._given, RADIUS))

    def errors(self, stars: Stars) -> Stars:
        """Return standard errors, the roots of the diagonal of ``F^-1``; infinite where F is 0."""
        n = len(stars.fluxes)
        _, information = self.derivatives(stars)
        roots = np.sqrt(np.maximum(np.diag(_invert(information)), 0.0))
        errors: Array = np.where(np.diag(information) > 0, roots, np.inf)
        return Stars(errors[:n], errors[n:].reshape(2, n).T)


def _invert(information: Array) -> Array:
    """Return the inverse, in units of its diagonal's: those of fluxes and positions are far apart.

    What is not known at all, such as the position of a star of no flux, has rows of 0.
    """
    roots = np.sqrt(np.diag(information))
    units = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > 0)
    units = units[:, None] * units
    inverse = np.asarray(np.linalg.pinv(information * units, hermitian=True), np.float64)
    return inverse * units


def _cut(psfs: list[Array]) -> list[Array]:
    """Return PSFs cut to the square round their middle that holds enough of the information."""
    # Where the star's own light is the noise, a pixel says |grad P|^2 / P of a position.
    information = sum(
        (np.square(np.gradient(np.pad(psf, 1))).sum(axis=0)[1:-1, 1:-1])
        / np.maximum(psf, LEAST_LIT * psf.max())
        for psf in psfs
    )
    middle = np.array(psfs[0].shape) // 2
    y, x = np.indices(psfs[0].shape)
    distance = np.maximum(abs(y - middle[0]), abs(x - middle[1]))
    within = np.cumsum(np.bincount(distance.ravel(), np.ravel(information)))
    half = int(np.argmax(within >= INFORMATION_SHARE * within[-1]))
    first = np.maximum(middle - half, 0)
    cut = np.s_[first[0] : middle[0] + half + 1, first[1] : middle[1] + half + 1]
    return [psf[cut] for psf in psfs]


def _shorten(vectors: Array, longest: float) -> Array:
    lengths = np.hypot(*vectors.T)[:, None]
    return vectors * np.minimum(1.0, longest / np.maximum(lengths, longest))
