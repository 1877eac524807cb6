"""
When to stop
============

The first iterations undo the blur, later ones make noise grow. Where the truth is unknown, what is
the right number? By default lnocl divides the counts at random into two halves, reconstructs both,
and lets each judge the other: held-out counts. This page compares that choice with the truth.
"""

# %%
# The exposure is short, so that noise comes soon. A long run without smoothing notes its
# :term:`restoration error` after each iteration: a ``callback`` is called with the estimate so
# far. Another run is left to held-out counts. Light that leaves a simulated image at one edge
# comes in at the opposite edge: ``pad=0``.

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import PowerNorm

import lnocl
from lnocl.metrics import restoration_error
from lnocl.simulation import Experiment, hh34, simulate

seen = simulate(hh34(128), Experiment(exposure_time="10 s"))
observation = lnocl.Observation(
    seen.images,
    seen.psfs,
    psf_error=0,
    background=seen.background,
    read_noise=seen.read_noise,
)
options = {"smoothing": 0, "pad": 0}
errors, images = [], {}


def look(iteration, estimate):
    """Note the error, and the jet after 5 and 400 iterations."""
    errors.append(restoration_error(estimate.extended, seen.extended))
    if iteration in (5, 400):
        images[f"{iteration} iterations"] = estimate.extended


long = lnocl.deconvolve(observation, seen.stars, n_iter=400, stop=None, callback=look, **options)
chosen = lnocl.deconvolve(observation, seen.stars, **options)

print(f"least error: {min(errors):.3f}, at iteration {np.argmin(errors) + 1}")
print(f"chosen by held-out counts: iteration {chosen.n_iter}, error", end=" ")
print(f"{restoration_error(chosen.extended, seen.extended):.3f}")
print(f"error after 400 iterations: {errors[-1]:.3f}")

# %%
images |= {f"{chosen.n_iter}, chosen": chosen.extended, "true jet": seen.extended}
fig, axes = plt.subplots(1, 4, figsize=(6.4, 4.3), sharey=True, layout="constrained")
for ax, (title, image) in zip(axes, images.items(), strict=True):
    shown = ax.imshow(image, origin="lower", norm=PowerNorm(0.5, 0, 400), cmap="inferno")
    ax.set(title=title, xlim=(34, 94), xlabel="x (pixels)")
axes[0].set_ylabel("y (pixels)")
fig.colorbar(
    shown,
    ax=axes,
    location="bottom",
    aspect=40,
    label="electrons per pixel",
    ticks=[0, 20, 100, 200, 400],
)
plt.show()

# %%
# After 5 iterations the knots are still one blur, after 400 they are grains of noise. The
# iteration chosen lies between.

fig, (top, bottom) = plt.subplots(2, 1, figsize=(6.4, 5.6), sharex=True, layout="constrained")
top.loglog(range(1, len(errors) + 1), errors, "k-", label="true")
top.loglog(chosen.held_out["iteration"], chosen.held_out["error"], "C0.", label="estimated")
top.axvline(chosen.n_iter, color="C0", lw=0.8, label="chosen")
top.set(ylabel="restoration error")
top.legend()
bottom.loglog(long.history["iteration"][1:], long.history["objective"][1:], "k-")
bottom.axvline(chosen.n_iter, color="C0", lw=0.8)
bottom.set(xlabel="iteration", ylabel="objective")
plt.show()

# %%
# The true error is least at iteration 17, where it is 0.158. Held-out counts choose iteration 24,
# with an error of 0.169. Their estimate of the error is too low, but it is least at the same
# iteration. The objective, which the run makes as small as it can, falls all the time, and does
# not show when to stop.
#
# By default held-out counts choose the smoothing too, which lowers the error further:

by_default = lnocl.deconvolve(observation, seen.stars, pad=0)
print(f"smoothing {by_default.smoothing:.1e}, {by_default.n_iter} iterations, error", end=" ")
print(f"{restoration_error(by_default.extended, seen.extended):.3f}")

# %%
# Held-out counts cannot see an error that both halves share, such as a wrong PSF.
#
# See also :doc:`/guide/choosing`.
