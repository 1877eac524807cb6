#!/bin/sh
# Two Chandra observations of Sgr A*, half a pixel apart: one sky from both.
# The first argument is the folder of the data, the second one for the output.
set -eu
# The iteration with which docs/validation/real.md was made.
paper="--solver sgm --stop none --smoothing 0 --pad 0 --psf-centre given"
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../../shared/data"}/chandra-sgra-pair
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
for id in 4683 4684; do
    python "$here/real.py" centred-psf "$data/chandra-psf-obs-id-$id.fits.gz" "$out/psf_$id.fits" 43
done
first=$data/chandra-counts-obs-id-4683.fits.gz second=$data/chandra-counts-obs-id-4684.fits.gz
psfs="$out/psf_4683.fits $out/psf_4684.fits"
# No background: a constant would be more than the darkest parts of the field, and add counts.
common="--pad 24 --n-iter 20 --residuals --quiet --overwrite"
lnocl deconvolve $paper "$first" "$second" --psf $psfs $common --align wcs -o "$out/aligned.fits"
lnocl deconvolve $paper "$first" "$second" --psf $psfs $common -o "$out/not_aligned.fits"
python "$here/real.py" figures "$out/aligned.fits" "$out/not_aligned.fits"
# The same on a sky twice as fine, whose pixels need not lie as those of either do.
for id in 4683 4684; do
    python "$here/real.py" finer-psf "$out/psf_$id.fits" "$out/finer_psf_$id.fits" 2
done
finer="--psf $out/finer_psf_4683.fits $out/finer_psf_4684.fits --oversample 2 --effective-psfs"
lnocl deconvolve $paper "$first" "$second" $finer $common --align wcs -o "$out/finer_aligned.fits"
lnocl deconvolve $paper "$first" "$second" $finer $common -o "$out/finer.fits"
python "$here/real.py" figures "$out/finer_aligned.fits" "$out/finer.fits"
# These two are not sampled alike; so the same again with half the offset on each image.
python "$here/real.py" offsets "$out/aligned.fits" "$first" "$second" $psfs 20
python "$here/real.py" draw "$out/chandra_pair.png" "4683, counts=$first:127,117,16:0:90" \
    "4684, counts=$second:127,117,16:0:90" \
    "both, offset 0=$out/not_aligned.fits:127,117,16:0:150" \
    "both, offset of the WCS=$out/aligned.fits:127,117,16:0:150"
