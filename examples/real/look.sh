#!/bin/sh
# Three real frames as a new user takes them: stars found, deconvolved, drawn, and as a page.
# The first argument is the folder of the data, the second one for the output.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../../shared/data"}
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
common="--residuals --quiet --overwrite"

look() {
    lnocl report "$out/$1.fits" -o "$out/$1.html" --overwrite
}

# Four images of a quasar (HST F814W). The PSF that comes with it is too wide, and mended; the sky
# was subtracted, and its noise is 5.19 electrons.
quasar=$data/hst-lensed-quasar
lnocl stars "$quasar/quasar_F814W_sci.fits" --threshold 50 \
    -o "$out/stars.ecsv" --plot "$out/stars.png" --overwrite
lnocl deconvolve "$quasar/quasar_F814W_sci.fits" --psf "$quasar/quasar_F814W_psf.fits" \
    --exposure "$quasar/quasar_F814W_exptime.fits" --background 0 --read-noise 5.187 \
    --stars "$out/stars.ecsv" --refine --refine-psfs jitter pixels \
    --plot "$out/lensed_quasar.png" $common -o "$out/lensed_quasar.fits"
look lensed_quasar

# A quasar and its host (HST F125W), with a map of the inverse variance.
host=$data/hst-quasar-j0005
lnocl deconvolve "$host/sci_J0005-0006.fits" --psf "$host/sci_psf.fits" --psf-centre fit \
    --noise "ivar=$host/ivm_J0005-0006.fits" --exposure EXPTIME --star 64,64 --refine \
    --plot "$out/quasar_host.png" $common -o "$out/quasar_host.fits"
look quasar_host

# Two Chandra observations of Sgr A*, half a pixel apart: no star, two images of one sky.
pair=$data/chandra-sgra-pair
lnocl deconvolve "$pair/chandra-counts-obs-id-4683.fits.gz" \
    "$pair/chandra-counts-obs-id-4684.fits.gz" \
    --psf "$pair/chandra-psf-obs-id-4683.fits.gz" "$pair/chandra-psf-obs-id-4684.fits.gz" \
    --psf-centre fit --align wcs --plot "$out/galactic_centre.png" $common \
    -o "$out/galactic_centre.fits"
look galactic_centre
