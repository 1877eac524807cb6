"""Draw what ``lnocl demo`` leaves in a folder, to be read on a phone too.

``python docs/demo.py FOLDER PICTURE`` writes the PNG.
"""

import sys
from pathlib import Path

import numpy as np
from astropy.io import fits
from matplotlib.colors import AsinhNorm
from matplotlib.figure import Figure

# Half the side of the enlarged part, pixels.
HALF = 16
SIZE = 16


def main(folder, picture):
    """Draw truth, image and both reconstructions, whole and round the star, a stretch a row."""
    truth, rlm, mc_rl = (Path(folder, f"{name}.fits") for name in ("truth", "rlm", "mc-rl"))
    star = fits.getdata(truth, "STARS")[0]
    x, y = round(star["x"]), round(star["y"])
    background = fits.getheader(mc_rl)["BKG1"]
    panels = {
        "truth": fits.getdata(truth),
        "one image": fits.getdata(Path(folder, "image_1.fits")) - background,
        "RLM": fits.getdata(rlm),
        "MC-RL": fits.getdata(mc_rl),
    }
    figure = Figure((6.6, 3.5), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02)
    near = np.s_[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]
    for row, part in zip(figure.subplots(2, 4), (np.s_[:, :], near), strict=True):
        top = panels["MC-RL"][part].max()
        for axis, (title, image) in zip(row, panels.items(), strict=True):
            axis.imshow(image[part], norm=AsinhNorm(0.01 * top, 0, top), origin="lower")
            axis.set(xticks=[], yticks=[])
            if part is not near:
                axis.set_title(title, fontsize=SIZE)
        row[0].set_ylabel("near the star" if part is near else "all", fontsize=SIZE)
    figure.savefig(picture, dpi=130)


if __name__ == "__main__":
    main(*sys.argv[1:])
