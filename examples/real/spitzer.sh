#!/bin/sh
# Stars on the diffuse emission of the Galaxy (Spitzer, 4.5 um): 513 x 1025, MJy/sr, NaNs, and
# pixels as wide as the PSF.
# The first argument is the folder of the data, the second one for the output.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../../shared/data"}/spitzer-glimpse
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
image=$data/spitzer_glimpse_irac2_l18.fits
# No PSF comes with it: take what 0.85 m see at 4.493 um, FWHM 1.12 arcsec of pixels of 1.2.
python "$here/real.py" airy-psf "$out/psf.fits" 0.936 16 2
# Electrons in 1 MJy/sr: GAIN x EXPTIME / FLUXCONV of the header = 3.7 x 1.2 / 0.141823635. No
# background: all of the emission is the sky's.
lnocl deconvolve "$image" --psf "$out/psf.fits" --oversample 2 --gain 31.306 \
    --star 442,344 --star 459,201 --star 174,151 --star 397,81 --star 561,254 --star 450,269 \
    --refine --n-iter 60 --stop none --residuals --overwrite -o "$out/spitzer.fits"
python "$here/real.py" figures "$out/spitzer.fits"
python "$here/real.py" draw "$out/spitzer.png" "image, MJy/sr=$image:450,270,100:2:300" \
    "extended, MJy/sr=$out/spitzer.fits:900,540,200:0:75" \
    "residuals=$out/spitzer.fits,RESIDUALS:450,270,100:-5:5"
