#!/bin/sh
# Stars on the diffuse emission of the Galaxy (Spitzer, 4.5 um): 513 x 1025, MJy/sr, NaNs.
# The first argument is the folder of the data, the second one for the output.
set -eu
# The iteration with which docs/real.md was made.
paper="--solver sgm --stop none --smoothing 0 --pad 0 --psf-centre given"
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../shared/data"}/spitzer-glimpse
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
image=$data/spitzer_glimpse_irac2_l18.fits
# No PSF comes with it: take an isolated star that is not saturated.
python "$here/real.py" star-psf "$image" "$out/psf.fits" 442,344 33
# Electrons in 1 MJy/sr: GAIN x EXPTIME / FLUXCONV of the header = 3.7 x 1.2 / 0.141823635.
lnocl deconvolve $paper "$image" --psf "$out/psf.fits" --gain 31.306 --background auto --pad 16 \
    --star 442,344 --star 459,201 --star 174,151 --star 397,81 --star 561,254 --star 450,269 \
    --refine --n-iter 30 --models --residuals --overwrite -o "$out/spitzer.fits"
python "$here/real.py" figures "$out/spitzer.fits"
python "$here/real.py" draw "$out/spitzer.png" "image, MJy/sr=$image:450,270,100:2:300" \
    "extended, MJy/sr=$out/spitzer.fits:450,270,100:0:290" \
    "residuals=$out/spitzer.fits,RESIDUALS:450,270,100:-20:20"
