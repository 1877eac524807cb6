"""Draw the picture of the page on a first image: ``python docs/first.py FILE.png``."""

import sys

import lnocl
from lnocl.simulation import Experiment, hh34, simulate

seen = simulate(hh34(128), Experiment(exposure_time="1 min"))
observation = lnocl.Observation(
    seen.images,
    seen.psfs,
    psf_error=0,
    background=seen.background,
    read_noise=seen.read_noise,
)
result = lnocl.deconvolve(observation, stars=seen.stars, pad=0)
result.plot().savefig(sys.argv[1], dpi=80)
