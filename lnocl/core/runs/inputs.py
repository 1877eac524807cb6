"""What a run is made of, in words and checksums, by which it is known again."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib.metadata import version
from numbers import Real
from typing import Any

import numpy as np

from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import numbers
from lnocl.core.scene.fields import FIELDS
from lnocl.core.scene.observation import Observation

# The most letters of a value: a SHA-256 in hexadecimal, or a parameter or the name of a device.
WIDTH = 256


def describe(setup: Setup, **parameters: Any) -> dict[str, str]:
    """Return the inputs and parameters of a run: checksums of arrays, other values in words."""
    bound = {
        "version": version("lnocl"),
        **inputs_of(setup.observation),
        **{name: value for name, value in vars(setup).items() if name != "observation"},
        **parameters,
    }
    bound |= {"device": setup.engine_name(), "tuning": setup.tuning_name()}
    return {name: _describe(name, value) for name, value in bound.items()}


def inputs_of(observation: Observation) -> dict[str, Any]:
    """Return the parameters of an observation, by their names."""
    bound = {name: getattr(observation, name) for name in (*FIELDS, "offsets", "turns")}
    if observation.component_names:
        bound["component_names"] = "; ".join(observation.component_names)
    if observation.psf_fields:
        bound["psf_fields"] = np.concatenate([each.numbers() for each in observation.psf_fields])
    return bound


def _describe(name: str, value: Any) -> str:
    if isinstance(value, (Real, np.bool_)):
        value = float(value)  # so that 1, True and np.float32(1) are the same
    if value is None or isinstance(value, (str, float)):
        return ascii(value)[:WIDTH]
    return digest_of({"": numbers(name, value).astype("<f8")})


def digest_of(*values: Mapping[str, Any]) -> str:
    """Return the SHA-256 of arrays and of other values in words, by their names."""
    digest = hashlib.sha256()
    for name, value in (item for each in values for item in sorted(each.items())):
        if isinstance(value, np.ndarray) and value.dtype.kind != "U":
            digest.update(repr((name, value.dtype.str, value.shape)).encode())
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(repr((name, str(value))).encode())
    return digest.hexdigest()
