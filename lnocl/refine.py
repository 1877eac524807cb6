"""Star positions and fluxes from the likelihood's own gradient, the extended source held fixed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lnocl.model import Model
from lnocl.observation import Array
from lnocl.placement import MARGIN, Stamp, differentiate, place
from lnocl.scene import LEAST_MODEL, Scene

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
# Steps end where they are less than this share of a standard error.
FINISHED = 0.01
MOST_STEPS = 30
MOST_HALVED = 10


class Stars(NamedTuple):
    """Fluxes, shape (n,), and positions, shape (n, 2), of stars."""

    fluxes: Array
    positions: Array


class StarFit:
    """The likelihood of stars, for an extended source that is known.

    ``J_0(c, x, y)`` with ``m_j = A_j f + sum_s c_s P_j(x_s, y_s) + b_j`` is minimised by Fisher
    scoring over all of them together, ``F = sum_j <D_j, w_j D_j / m_j>``, D the derivatives of the
    m_j: ``P_js`` and ``-c_s`` times the derivatives of the PSF along x and y. Looked at are squares
    round the stars that hold 99 % of the information on positions; the light of PSFs beyond them
    stays where the stars of the scene put it.

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
        self._psfs = _cut([_with_derivatives(psf) for psf in scene.scaled_psfs()])
        lit = self._lit_pixels()
        self._place = np.cumsum(lit) - 1
        self._n_lit = int(lit.sum())
        self._images = scene.images().ravel()[lit]
        self._diffuse = (model.forward(extended) + model.background).ravel()[lit]
        self._weights = model.weights.ravel()[lit]
        whole = [model.starlight(unit).ravel()[lit] for unit in np.eye(scene.n_stars)]
        self._beyond = np.array(whole).T - self._columns(0, scene.stars).toarray()

    def _stamp(self, j: int, psf: Array, position: Array) -> Stamp:
        x, y = position + self._scene.observation.offsets[j]
        return place(psf, self._scene.grid, x, y)

    def _lit_pixels(self) -> NDArray[np.bool_]:
        """Return which pixels of the images a star may light, wherever it goes."""
        grid, reach = self._scene.grid, int(np.ceil(2 * RADIUS))
        lit = np.zeros((self._scene.n_images, *grid), bool)
        for j, (_, derivative, _) in enumerate(self._psfs):
            for position in self._given:
                # Between pixels, where a PSF has its margins.
                stamp = self._stamp(j, np.pad(derivative, reach), np.floor(position) + 0.25)
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
        for j, psfs in enumerate(self._psfs):
            stamp = self._stamp(j, psfs[k], position)
            rows, columns = stamp.rows((ny, nx)), stamp.columns((ny, nx))
            pixels.append(((j * ny + rows)[:, None] * nx + columns).ravel())
            values.append(stamp.values.ravel())
        return self._place[np.concatenate(pixels)], np.concatenate(values)

    def _model(self, light: Any, fluxes: Array) -> Array:
        starlight = light @ fluxes + self._beyond @ fluxes
        return np.maximum(self._diffuse + starlight, LEAST_MODEL)

    def objective(self, stars: Stars) -> float:
        """Return J_0 over the pixels that stars may light, but for a constant."""
        model = self._model(self._columns(0, stars.positions), stars.fluxes)
        return float(self._weights @ (model - self._images * np.log(model)))

    def derivatives(self, stars: Stars) -> tuple[Array, Array]:
        """Return gradient and Fisher information of J_0 in (c_1 ... c_n, x_1 ..., y_1 ...)."""
        light, *moved = (self._columns(k, stars.positions) for k in range(3))
        model = self._model(light, stars.fluxes)
        light = light + sparse.csc_array(self._beyond)
        columns = sparse.hstack([light, *(each * stars.fluxes for each in moved)], format="csc")
        gradient = columns.T @ (self._weights * (1.0 - self._images / model))
        weighted = columns * (self._weights / model)[:, None]
        return gradient, (columns.T @ weighted).toarray()

    def minimise(self, stars: Stars) -> Stars:
        """Return the stars that are most likely, sought from these."""
        objective = self.objective(stars)
        for _ in range(MOST_STEPS):
            gradient, information = self.derivatives(stars)
            step = -np.linalg.pinv(information, hermitian=True) @ gradient
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
        """Return standard errors, the roots of the diagonal of ``F^-1``."""
        n = len(stars.fluxes)
        _, information = self.derivatives(stars)
        variances = np.diag(np.linalg.pinv(information, hermitian=True))
        roots = np.sqrt(np.maximum(variances, 0.0))
        return Stars(roots[:n], roots[n:].reshape(2, n).T)


def _with_derivatives(psf: Array) -> list[Array]:
    """Return a PSF with margins, and what changes where it is moved along x and along y."""
    return [np.pad(psf, MARGIN), -differentiate(psf, 1), -differentiate(psf, 0)]


def _cut(psfs: list[list[Array]]) -> list[list[Array]]:
    """Return PSFs cut to the square round their middle that holds enough of the information."""
    # Where the star's own light is the noise, a pixel says |grad P|^2 / P of a position.
    information = sum(
        (dx**2 + dy**2) / np.maximum(psf, LEAST_LIT * psf.max()) for psf, dx, dy in psfs
    )
    ky, kx = information.shape
    y, x = np.indices(information.shape)
    distance = np.maximum(abs(y - ky // 2), abs(x - kx // 2))
    within = np.cumsum(np.bincount(distance.ravel(), information.ravel()))
    half = int(np.argmax(within >= INFORMATION_SHARE * within[-1]))
    cut = np.s_[
        max(ky // 2 - half, 0) : ky // 2 + half + 1, max(kx // 2 - half, 0) : kx // 2 + half + 1
    ]
    return [[np.ascontiguousarray(each[cut]) for each in three] for three in psfs]


def _shorten(vectors: Array, longest: float) -> Array:
    lengths = np.hypot(*vectors.T)[:, None]
    return vectors * np.minimum(1.0, longest / np.maximum(lengths, longest))
