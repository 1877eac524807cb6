#!/bin/sh
# Two Chandra observations of Sgr A*, half a pixel apart: one sky from both.
# The first argument is the folder of the data, the second one for the output.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../shared/data"}/chandra-sgra-pair
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
# PSFs centred; the 64 x 64 pixels around Sgr A*, with their coordinates.
for id in 4683 4684; do
    python "$here/real.py" centred-psf "$data/chandra-psf-obs-id-$id.fits.gz" "$out/psf_$id.fits" 43
    python "$here/real.py" field "$data/chandra-counts-obs-id-$id.fits.gz" "$out/counts_$id.fits" \
        127,117 32
done
both="$out/counts_4683.fits $out/counts_4684.fits --psf $out/psf_4683.fits $out/psf_4684.fits"
common="--pad 24 --n-iter 100 --models --residuals --quiet --overwrite"
lnocl deconvolve $both $common --align wcs -o "$out/aligned.fits"
lnocl deconvolve $both $common -o "$out/not_aligned.fits"
python "$here/real.py" figures "$out/aligned.fits" "$out/not_aligned.fits"
python "$here/real.py" draw "$out/chandra_pair.png" \
    "4683, counts=$out/counts_4683.fits:32,32,16:0:90" \
    "4684, counts=$out/counts_4684.fits:32,32,16:0:90" \
    "both, offset 0=$out/not_aligned.fits:32,32,16:0:150" \
    "both, offset of the WCS=$out/aligned.fits:32,32,16:0:150"
