#!/bin/sh
# A quasar seen by Chandra: one point, and nearly nothing else.
# The first argument is the folder of the data, the second one for the output.
set -eu
# The iteration with which docs/validation/real.md was made.
paper="--solver sgm --stop none --smoothing 0 --pad 0 --psf-centre given"
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../../shared/data"}/chandra-pg1634-point
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
counts=$data/pg1634_counts_0.25pix.fits
# The PSF file is that of the mirrors; the counts were spread by the pixels, twice.
python "$here/real.py" pixel-psf "$data/pg1634_psf_0.25pix.fits" "$out/psf.fits"
# Background: 15 counts in 5884 pixels, 55 to 70 pixels from the star.
known="--background 0.0025 --star 89,76 --n-iter 30 --residuals --quiet --overwrite"
for refine in "" --refine; do
    for psf in "$data/pg1634_psf_0.25pix.fits" "$out/psf.fits"; do
        name=$(basename "$psf" .fits)$refine
        lnocl deconvolve $paper "$counts" --psf "$psf" $known $refine -o "$out/$name.out.fits"
        python "$here/real.py" figures "$out/$name.out.fits"
    done
done
# 1831 counts less 24843 pixels of background 0.0025 are 1769 counts of the quasar.
python "$here/real.py" draw "$out/chandra_point.png" "counts=$counts:89,76,25:0:50" \
    "extended, PSF of the file=$out/pg1634_psf_0.25pix--refine.out.fits:89,76,25:0:10" \
    "extended, PSF with pixels=$out/psf--refine.out.fits:89,76,25:0:10"
