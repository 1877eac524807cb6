#!/bin/sh
# Four images of a quasar between pixels on a faint ring (HST F814W): stars refined, or not.
# The first argument is the folder of the data, the second one for the output.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../shared/data"}/hst-lensed-quasar
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
sci=$data/quasar_F814W_sci.fits exptime=$data/quasar_F814W_exptime.fits

# The PSF that comes with the data is twice as wide as the stars: make one of the four stars.
python "$here/real.py" stars-psf "$sci" "$exptime" "$out/psf.fits"

# Electrons per second, with a map of the exposure; the sky was subtracted, its noise is 5.19 e-.
known="--psf $out/psf.fits --exposure $exptime --read-noise 5.187 --pad 4 --quiet --overwrite"
stars="--star 77,73 --star 47,56 --star 55,77 --star 73,48"
for n in 3 10 30 100 300; do
    lnocl deconvolve "$sci" $known $stars --n-iter $n --models --residuals -o "$out/whole_$n.fits"
    lnocl deconvolve "$sci" $known $stars --refine --n-iter $n --models --residuals \
        -o "$out/refined_$n.fits"
    python "$here/real.py" figures "$out/whole_$n.fits" "$out/refined_$n.fits"
done
# Plain Richardson-Lucy: no stars.
lnocl deconvolve "$sci" $known --n-iter 100 -o "$out/plain.fits"
# With the PSF of the file, for comparison: nothing but another PSF helps.
for refine in "" --refine; do
    lnocl deconvolve "$sci" --psf "$data/quasar_F814W_psf.fits" --exposure "$exptime" \
        --read-noise 5.187 --pad 4 --quiet $stars $refine --n-iter 30 --models --residuals \
        -o "$out/file_psf$refine.fits" --overwrite
    python "$here/real.py" figures "$out/file_psf$refine.fits"
done
python "$here/real.py" draw "$out/lensed_quasar.png" "image, e-/s=$sci:62,62,32:0:0.5" \
    "Richardson-Lucy, 100=$out/plain.fits:62,62,32:0:0.3" \
    "refined stars, 30=$out/refined_30.fits:62,62,32:0:0.3" \
    "residuals, whole pixels=$out/whole_30.fits,RESIDUALS:62,62,32:-10:10" \
    "residuals, refined=$out/refined_30.fits,RESIDUALS:62,62,32:-10:10"
