"""Images of a star and its jet through a Fizeau interferometer, as the paper simulated them.

The experiment is that of La Camera et al. (2012), section 3. A target has stars and an extended
source. Each image has its own PSF, for one hour angle, and the photon noise of target and sky, and
read noise.
"""

from lnocl.simulation.fizeau import fizeau_psf
from lnocl.simulation.images import Simulation, simulate
from lnocl.simulation.pupil import circular_pupil, fizeau_pupil
from lnocl.simulation.targets import Star, Target, hh34, load_target
from lnocl.simulation.telescope import Experiment

__all__ = [
    "Experiment",
    "Simulation",
    "Star",
    "Target",
    "circular_pupil",
    "fizeau_psf",
    "fizeau_pupil",
    "hh34",
    "load_target",
    "simulate",
]
