#!/bin/sh
# Four images of a quasar between pixels on a faint ring (HST F814W): stars refined, or not.
# The first argument is the folder of the data, the second one for the output.
set -eu
# The iteration with which docs/validation/real.md was made.
paper="--solver sgm --stop none --smoothing 0 --pad 0 --psf-centre given"
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../../shared/data"}/hst-lensed-quasar
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
sci=$data/quasar_F814W_sci.fits exptime=$data/quasar_F814W_exptime.fits

# The PSF that comes with the data is twice as wide as the stars: make one of the four stars.
python "$here/real.py" stars-psf "$sci" "$exptime" "$out/psf.fits"

# Electrons per second, with a map of the exposure; the sky was subtracted, its noise is 5.19 e-.
known="--exposure $exptime --background 0 --read-noise 5.187 --pad 4"
known="$known --residuals --quiet --overwrite"
stars="--star 77,73 --star 47,56 --star 55,77 --star 73,48"
for how in "0 30" "0 300" "0.0328 30" "0.0328 300"; do
    set -- $how
    for refine in "" --refine; do
        lnocl deconvolve $paper "$sci" --psf "$out/psf.fits" $known $stars $refine \
            --smoothing "$1" --n-iter "$2" -o "$out/smoothing_$1_$2$refine.fits"
        python "$here/real.py" figures "$out/smoothing_$1_$2$refine.fits"
    done
done
# Plain Richardson-Lucy: no stars.
lnocl deconvolve $paper "$sci" --psf "$out/psf.fits" $known --n-iter 100 -o "$out/plain.fits"
# With the PSF of the file, for comparison: nothing but another PSF helps.
lnocl deconvolve $paper "$sci" --psf "$data/quasar_F814W_psf.fits" $known $stars --refine --n-iter 30 \
    -o "$out/file_psf.fits"
python "$here/real.py" figures "$out/file_psf.fits"
python "$here/real.py" draw "$out/lensed_quasar.png" "image, e-/s=$sci:62,62,32:0:0.5" \
    "Richardson-Lucy, 100=$out/plain.fits:62,62,32:0:0.2" \
    "refined stars, 300=$out/smoothing_0_300--refine.fits:62,62,32:0:0.2" \
    "refined, 300, smoothing=$out/smoothing_0.0328_300--refine.fits:62,62,32:0:0.2" \
    "residuals, whole pixels=$out/smoothing_0.0328_300.fits,RESIDUALS:62,62,32:-10:10" \
    "residuals, refined=$out/smoothing_0.0328_300--refine.fits,RESIDUALS:62,62,32:-10:10"
