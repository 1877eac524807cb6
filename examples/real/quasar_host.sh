#!/bin/sh
# A quasar of redshift 5.85 and its surroundings (HST F125W): the point taken out.
# The first argument is the folder of the data, the second one for the output.
set -eu
# The iteration with which docs/validation/real.md was made.
paper="--solver sgm --stop none --smoothing 0 --pad 0 --psf-centre given"
here=$(cd "$(dirname "$0")" && pwd)
data=${1:-"$here/../../../shared/data"}/hst-quasar-j0005
out=${2:-$(mktemp -d)}
mkdir -p "$out"
[ -d "$data" ] || { echo "skipped: $data is not there"; exit 0; }
sci=$data/sci_J0005-0006.fits
# The PSF star is noisy and has negative pixels; its background was subtracted.
python "$here/real.py" centred-psf "$data/sci_psf.fits" "$out/psf.fits" 63
known="--psf $out/psf.fits --background 0 --noise ivar=$data/ivm_J0005-0006.fits"
known="$known --exposure EXPTIME --pad 16"
how="--solver sgp --n-iter 10 --residuals --quiet --overwrite"
lnocl deconvolve $paper "$sci" $known --star 64,64 $how -o "$out/whole.fits"
lnocl deconvolve $paper "$sci" $known --star 64,64 --refine $how -o "$out/refined.fits"
python "$here/real.py" figures "$out/whole.fits" "$out/refined.fits"
python "$here/real.py" draw "$out/quasar_host.png" "image, e-/s=$sci:64,64,50:0:0.3" \
    "extended, whole pixel=$out/whole.fits:64,64,50:0:0.3" \
    "extended, refined=$out/refined.fits:64,64,50:0:0.3" \
    "residuals, refined=$out/refined.fits,RESIDUALS:64,64,50:-10:10"
