r"""Components: several skies, of which each image shows a mixture that is known.

.. math:: m_j = e_j A_j \sum_k w_{jk} f_k + \sum_s c_{sj} P_{js} + b_j

An image in a line shows line and continuum, w = (1, 1); one beside it the continuum, w = (0, 1).
Images of equal weights are those of one filter. What they show of the skies is one sky, so that
all that is known of the images of a filter, their PSFs and stars, is judged as with one sky
(`parts`). Stars have a flux in each filter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array, numbers, refuse_unless
from lnocl.errors import InputError, counted

if TYPE_CHECKING:
    from lnocl.core.scene.fields import Field
    from lnocl.core.scene.observation import Observation

# The component that the light of others is compared with.
CONTINUUM = "continuum"
# The largest weight, and the inverse of the least: others would leave the range of float32.
LARGEST = 1e6
# The most components, such as slices of a cube.
MOST = 64
# The least singular value of the weights, over the largest, that tells components apart.
TOLD_APART = 1e-3


@dataclass(frozen=True)
class Mixing:
    """How images show the components.

    Attributes
    ----------
    weights : ndarray of float64, shape (p, K)
        w.
    filters : ndarray of int, shape (p,)
        The filter of each image, from 0 on: those of equal weights are of one.
    rows : ndarray of float64, shape (G, K)
        The weights of each filter.
    names : sequence of str
        Of the components.
    """

    weights: Array
    filters: NDArray[np.intp]
    rows: Array
    names: Sequence[str]

    @classmethod
    def of(cls, weights: Array, names: Sequence[str] = ()) -> Mixing:
        """Return that of weights, the filters in the order in which images have them first."""
        _, first, numbered = np.unique(weights, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        filters = np.argsort(order)[numbered.ravel()]
        return cls(weights, filters, weights[first[order]], names)

    def seen(self, skies: Array) -> list[Array]:
        """Return what each filter shows of the skies, (K, ...), as one sky each."""
        return [np.einsum("k,k...->...", row, skies) for row in self.rows]

    @property
    def undone(self) -> Array:
        """The weights of the filters' skies in each component, shape (K, G): the pseudo-inverse."""
        return np.asarray(np.linalg.pinv(self.rows))

    def components(self, of_filters: Sequence[Array]) -> Array:
        """Return the skies, shape (K, ...), that are nearest to what each filter shows."""
        return np.einsum("kg,g...->k...", self.undone, np.array(of_filters))

    def told_by(self, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return where the filters that see a pixel, (G, ny, nx), tell the components apart."""
        if seen.all():
            return np.ones(seen.shape[1:], bool)
        flat = seen.reshape(len(seen), -1)
        packed = np.packbits(flat, axis=0)
        _, first, at = np.unique(packed, axis=1, return_index=True, return_inverse=True)
        rows = self.rows / self.rows.max(axis=0)
        ranks = [np.linalg.matrix_rank(rows[those], TOLD_APART) for those in flat[:, first].T]
        return np.asarray((np.array(ranks) == rows.shape[1])[at.ravel()].reshape(seen.shape[1:]))

    @property
    def images(self) -> list[list[int]]:
        """The images of each filter."""
        return [np.flatnonzero(self.filters == g).tolist() for g in range(len(self.rows))]

    @property
    def filter_names(self) -> list[str]:
        """The name of each filter: the components that it shows, with weights where needed."""
        lit = [[(w, n) for w, n in zip(row, self.names, strict=True) if w] for row in self.rows]
        short = [" + ".join(name for _, name in each) for each in lit]
        longer = [" + ".join(f"{w:.4g} {name}" for w, name in each) for each in lit]
        return [b if short.count(a) > 1 else a for a, b in zip(short, longer, strict=True)]


def read_components(field: Field, value: Any, held: Observation) -> Array:
    """Return the weights of components in each image, shape (p, K); K is 0 where there are none.

    Their names are held too.
    """
    n_images = held.n_images
    if value is None:
        held.component_names = ()
        return np.zeros((n_images, 0))
    if isinstance(value, Mapping):
        weights = _by_name(field.name, value, n_images)
        held.component_names = tuple(map(str, value))
    else:
        weights = numbers(field.name, value)
    if weights.shape != (n_images, len(getattr(held, "component_names", ()))):
        raise InputError(
            f"`{field.name}` must be names with a weight for each of the {n_images} images, such "
            "as {'line': [1, 0], 'continuum': [1, 1]}"
        )
    in_range = (weights == 0) | ((weights >= 1.0 / LARGEST) & (weights <= LARGEST))
    refuse_unless(
        f"`{field.name}`", weights, f"0, or from {1 / LARGEST:g} to {LARGEST:g}", in_range
    )
    _refuse_unclear(weights, held.component_names)
    return weights


def read_component_errors(field: Field, value: Any, held: Observation) -> Array:
    """Return the standard errors of the weights, shape (p, K)."""
    shape = held.components.shape
    if value is None:
        return np.zeros(shape)
    if not isinstance(value, Mapping):
        errors = numbers(field.name, value)
    else:
        if unknown := [name for name in value if name not in held.component_names]:
            raise InputError(f"`{field.name}` names {unknown[0]!r}, which is no component")
        given = {name: value.get(name, 0.0) for name in held.component_names}
        errors = _by_name(field.name, given, shape[0])
    if errors.shape != shape:
        raise InputError(f"`{field.name}` has shape {errors.shape}; the components have {shape}")
    refuse_unless(f"`{field.name}`", errors, "finite and not negative", errors >= 0)
    return errors


def in_filters(
    held: Observation, numbered: NDArray[np.intp], labels: Sequence[str]
) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Return epochs and their labels where stars have a flux in each filter of each."""
    mixing = Mixing.of(held.components, held.component_names)
    keys = mixing.filters * len(labels) + numbered
    distinct, numbers_of = np.unique(keys, return_inverse=True)
    names, texts = mixing.filter_names, []
    for key in distinct.tolist():
        g, epoch = divmod(key, len(labels))
        texts.append(names[g] if len(labels) == 1 else f"{names[g]}, {labels[epoch]}")
    return numbers_of.ravel().astype(np.intp), tuple(texts)


def refuse_unseen(observation: Observation) -> None:
    """Refuse an observation in which no good pixel shows a filter."""
    if (mixing := observation.mixing) is None:
        return
    for name, images in zip(mixing.filter_names, mixing.images, strict=True):
        if observation.mask[images].all():
            raise InputError(f"no good pixel shows {name}: leave its images and components out")


def _by_name(parameter: str, value: Mapping[Any, Any], n_images: int) -> Array:
    """Return the numbers of each name in each image, shape (p, K)."""
    columns = []
    for name, given in value.items():
        each = numbers(f"{parameter}[{name!r}]", given)
        if each.shape not in ((), (n_images,)):
            raise InputError(
                f"`{parameter}[{name!r}]` has shape {each.shape}; give a number for each of the "
                f"{n_images} images"
            )
        columns.append(np.broadcast_to(each, (n_images,)))
    return np.array(columns).reshape(len(columns), n_images).T.copy()


def _refuse_unclear(weights: Array, names: Sequence[str]) -> None:
    """Refuse weights by which images do not tell the components apart."""
    if not 2 <= len(names) <= MOST:
        raise InputError(
            f"`components` has {counted(len(names), 'name')}; give 2 to {MOST}, or leave it out"
        )
    if len({*names} - {""}) < len(names):
        raise InputError("`components` has a name that is empty, or there twice; give each its own")
    if dark := [name for name, each in zip(names, weights.T, strict=True) if not each.any()]:
        raise InputError(f"no image shows the component {dark[0]!r}: its weights are all 0")
    if blind := np.flatnonzero(~weights.any(axis=1)).tolist():
        raise InputError(f"`images[{blind[0]}]` shows no component: its weights are all 0")
    values = np.linalg.svd(weights / weights.max(axis=0), compute_uv=False)
    if len(values) < len(names) or values[-1] < TOLD_APART * values[0]:
        raise InputError(
            f"the images do not tell {' and '.join(names)} apart: give one that shows these with "
            "other weights, such as one beside the line"
        )
