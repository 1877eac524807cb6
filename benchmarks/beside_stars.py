"""Companions that are found beside a star, and what speckles raise as alarms.

    python benchmarks/beside_stars.py companions|alarms [--seeds FIRST LAST]
        [--psfs exact noisy] [--distances D ...] [--times T ...] [--completeness P]
        [--speckles E ...] [--output FILE.ecsv]

A star of 1e6 electrons on a sky of 50, in 64 x 64 pixels, through a pupil with aberrations that
are others for each seed; lambda / D is 2.8 pixels, and its FWHM 3. All is by default.

companions  of T times the flux that is found with probability P, 0.9 by default, as stated where
            there is none, at D FWHM; the PSF is exact, or the image of a star twice as bright. The
            table has for each PSF, distance and flux the share found within .7 resolutions, the
            median of flux over truth, and the rms of errors over those stated; 0 in n where the
            limit is not a number
alarms      detections where there is none; the PSF has other speckles, so that it is off by a share
            E in the L2 norm. The table has the alarms a field, beside those stated
"""

import argparse
import warnings

import numpy as np
from astropy.table import Table
from blind_psfs import optics, speckles
from honest import coarse, middle, seen

import lnocl

N, STAR, SKY = 64, 1e6, 50.0
SIDE, FWHM = 51, 3.0


def pupil_psf(phases, waves):
    """Return a PSF of unit sum, collected in pixels."""
    return coarse(optics(3 * SIDE, 8.4, phases, waves, 0.9), 3)


def detections(counts, psf, star):
    """Return the map of significance."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        observation = lnocl.Observation(counts, psf, background=SKY, psf_centre="given")
        return lnocl.deconvolve(observation, [star]).significance()


def companions(seed, given):
    """Yield a row for each companion."""
    for kind in given.psfs:
        rng = np.random.default_rng([seed, 56])
        true, star = pupil_psf(rng.normal(0, 0.15, 5), speckles(rng)), middle(rng, N)
        psf = true if kind == "exact" else rng.poisson(2 * STAR * true + SKY) - SKY
        alone = SKY + seen(N, true, star, [STAR])
        limit = detections(rng.poisson(alone), psf, star).limit(given.completeness)
        for distance in given.distances:
            for times in given.times:
                turn = rng.uniform(0, 2 * np.pi)
                at = star + distance * FWHM * np.array([np.cos(turn), np.sin(turn)])
                x, y = np.round(at).astype(int)
                row = {"psf": kind, "distance": distance, "times": times, "seed": seed}
                row |= {"limit": limit[y, x], "found": False, "flux": np.nan, "sigmas": np.nan}
                if np.isfinite(limit[y, x]):
                    flux = times * limit[y, x]
                    maps = detections(rng.poisson(alone + seen(N, true, at, [flux])), psf, star)
                    for each in maps.detections:
                        off = np.hypot(each["x"].value - at[0], each["y"].value - at[1])
                        if off < 0.7 * maps.resolution and not row["found"]:
                            row["found"], row["flux"] = True, each["flux"].value / flux
                            error = each["flux_error"].value
                            row["sigmas"] = (each["flux"].value - flux) / error
                yield row


def alarms(seed, given):
    """Yield a row for each error of the PSF."""
    for share in given.speckles:
        rng = np.random.default_rng([seed, 57])
        phases, waves, star = rng.normal(0, 0.15, 5), speckles(rng), middle(rng, N)
        true, other = pupil_psf(phases, waves), pupil_psf(phases, speckles(rng))
        psf = true + share * np.linalg.norm(true) / np.linalg.norm(other - true) * (other - true)
        maps = detections(rng.poisson(SKY + seen(N, true, star, [STAR])), psf, star)
        most = max(maps.detections["significance"].value, default=0.0)
        row = {"speckles": share, "seed": seed, "alarms": len(maps.detections)}
        yield row | {"stated": maps.false_alarms, "most": float(most)}


def summarise(table, keys):
    """Return a row for each kind of run."""
    rows = []
    for group in table.group_by(keys).groups:
        row = {key: group[key][0] for key in keys}
        if "alarms" in table.colnames:
            row |= {"fields": len(group), "alarms": np.mean(group["alarms"])}
            row |= {"stated": np.mean(group["stated"]), "most": max(group["most"])}
        else:
            tried, found = group[np.isfinite(group["limit"])], group[group["found"]]
            row |= {"n": len(tried), "limit": np.median(tried["limit"]) if len(tried) else np.nan}
            row["found"] = np.mean(tried["found"]) if len(tried) else np.nan
            row["flux"] = np.median(found["flux"]) if len(found) else np.nan
            row["sigmas"] = np.sqrt(np.mean(found["sigmas"] ** 2)) if len(found) else np.nan
        rows.append(row)
    summary = Table(rows)
    for name in summary.colnames[len(keys) + 1 :]:
        summary[name].format = "%.2f"
    return summary


def main():
    """Print and write the table of a part."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("companions", "alarms"))
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 9), metavar=("FIRST", "LAST"))
    parser.add_argument("--psfs", nargs="+", choices=("exact", "noisy"), default=["exact", "noisy"])
    parser.add_argument("--distances", nargs="+", type=float, default=[1, 1.5, 2, 3, 4, 6])
    parser.add_argument("--times", nargs="+", type=float, default=[1, 3, 10, 30, 100])
    parser.add_argument("--completeness", type=float, default=0.9)
    parser.add_argument("--speckles", nargs="+", type=float, default=[0.005, 0.01, 0.02, 0.05])
    parser.add_argument("--output", metavar="FILE.ecsv")
    given = parser.parse_args()
    measure, rows = {"companions": companions, "alarms": alarms}[given.part], []
    for seed in range(given.seeds[0], given.seeds[1] + 1):
        for row in measure(seed, given):
            print(*(f"{x:.4g}" if isinstance(x, float) else x for x in row.values()), flush=True)
            rows.append(row)
        if given.output:
            Table(rows).write(given.output, overwrite=True)
    keys = ["speckles"] if given.part == "alarms" else ["psf", "distance", "times"]
    summarise(Table(rows), keys).pprint(max_lines=-1, max_width=-1)


if __name__ == "__main__":
    main()
