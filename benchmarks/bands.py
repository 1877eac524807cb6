"""The paper's figures of light and width along the jet, with the bands of the bootstrap.

    python benchmarks/bands.py [--size 512] [--replicas 50] [--seed 0] --output FOLDER

The paper's experiment on `hh34`, reconstructed by default. Light and width of each row, the width
the number of pixels above the paper's threshold, are measured in each replica; what is printed is
the share of the rows of the jet whose true value lies in the intervals.
"""

import argparse
from pathlib import Path

import numpy as np
from experiment import NEAR_STAR, width_profile, width_threshold

import lnocl
from lnocl import metrics
from lnocl.core.runs.bootstrap import Bootstrap, Quantity
from lnocl.core.runs.replicas import Replicas
from lnocl.plotting.figure import save_figure
from lnocl.plotting.profiles import draw_bands
from lnocl.simulation import Experiment, hh34, simulate

# Rows of less light than this share of the brightest are not the jet's.
FAINT = 0.01


def main():
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--replicas", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, required=True)
    given = parser.parse_args()
    made = simulate(hh34(given.size), Experiment(seed=given.seed))
    observation = lnocl.Observation(
        made.images, made.psfs, background=made.background, read_noise=made.read_noise
    )
    result = lnocl.deconvolve(observation, made.stars, n_iter=4000)
    print(f"{result.n_iter} iterations, smoothing {result.smoothing:.3g}")
    threshold = width_threshold(made.extended)

    def measure(sky):
        return np.concatenate([metrics.flux_profile(sky), width_profile(sky, threshold)])

    replicas, errors = Replicas(result._outcome, given.seed), []
    for k in range(given.replicas):
        drawn, found, _ = replicas.reconstruct(k)
        errors.append(measure(found.extended) - measure(drawn.extended))
    values, truth = measure(result.extended), measure(made.extended)
    quantities = tuple(Quantity("", "flux", value) for value in values)
    found = Bootstrap(
        quantities, np.array(errors), np.zeros(0), np.zeros((2, 1, 1)), 1.0, given.seed
    )
    rows = np.arange(given.size)
    star = made.stars[0][1]
    is_jet = truth[: given.size] > FAINT * truth[: given.size].max()
    is_near = is_jet & (abs(rows - star) <= NEAR_STAR)
    parts = {}
    for start, kind in ((0, "light"), (given.size, "width")):
        where = slice(start, start + given.size)
        parts[kind] = {"at": rows - star, "value": values[where], "bias": found.bias[where]}
        for level in (68, 95):
            low, high = found.interval(level / 100)[:, where]
            parts[kind] |= {f"low{level}": low, f"high{level}": high}
            inside = (low <= truth[where]) & (truth[where] <= high)
            shares = f"{inside[is_jet].mean():.2f} of {is_jet.sum()} rows of the jet"
            near = f"{inside[is_near].mean():.2f} of {is_near.sum()} near the star"
            print(f"{kind}, {level} %: holds the truth in {shares}, {near}")
    figure = draw_bands(
        f"hh34, {given.size} x {given.size}", {"": tuple(parts.values())}, "electrons"
    )
    for axis, start in zip(figure.axes, (0, given.size), strict=True):
        axis.plot(
            rows - star, truth[start : start + given.size], color="black", lw=0.8, label="truth"
        )
        axis.set_xlim(-0.05 * given.size, 0.7 * given.size)
    figure.axes[0].set_yscale("log")
    figure.axes[0].set_ylim(truth[: given.size].max() * 1e-3, truth[: given.size].max() * 3)
    figure.axes[0].legend(fontsize=9, ncols=5)
    given.output.mkdir(exist_ok=True)
    save_figure(figure, str(given.output / f"bands-{given.size}.png"), True)


if __name__ == "__main__":
    main()
